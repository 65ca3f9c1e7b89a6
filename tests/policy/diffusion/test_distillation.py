"""Distillation: what a student is to learn is where two steps of its teacher lead."""

from __future__ import annotations

import numpy as np
import torch

from servoid.policy.diffusion.distillation import distilled_losses, draw_step, stepped, target
from servoid.policy.diffusion.model.config import DenoiserConfig, TrainingObjective
from servoid.policy.diffusion.model.denoiser import Denoiser
from servoid.policy.diffusion.schedule import cosine_signal, ddim_levels, full_sequence

CONFIG = DenoiserConfig(3, 2, layers=1, width=16, heads=2, history=2, horizon=6, levels=20)
SIGNAL = torch.as_tensor(cosine_signal(CONFIG.levels), dtype=torch.float32)


def test_one_step_by_the_target_leads_where_the_teachers_steps_led() -> None:
    generator = torch.Generator().manual_seed(0)
    noisy, one, other = (torch.randn(4, 5, 3, generator=generator) for _ in range(3))
    before = torch.tensor([20, 20, 10, 3, 0]).expand(4, -1)
    after = torch.tensor([10, 0, 5, 3, 0]).expand(4, -1)
    middle = (before + after + 1) // 2
    reached = stepped(stepped(noisy, one, before, middle, SIGNAL), other, middle, after, SIGNAL)
    wanted = target(noisy, reached, before, after, SIGNAL)
    torch.testing.assert_close(stepped(noisy, wanted, before, after, SIGNAL), reached, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(reached[:, 3:], noisy[:, 3:])  # at rest
    torch.testing.assert_close(wanted[:, 1], other[:, 1])  # who gets to the end predicts what the teacher did there


def test_steps_are_those_of_a_plan_with_and_without_a_lead() -> None:
    generator = torch.Generator().manual_seed(0)
    (states, actions), (then_states, then_actions) = draw_step(CONFIG, 600, 2, generator, 1)
    assert (states[:, :2] == 0).all()  # the past
    assert (actions[:, 0] == 0).all()
    assert 0.4 < (actions[:, 1] == 0).float().mean() < 0.75  # runs already, or is finished
    seen = (states, actions, then_states, then_actions)
    rows = set(zip(*(x[:, -1].tolist() for x in seen), strict=True))
    plans = set()
    for lead in (0, 1):
        matrix = full_sequence(CONFIG.levels, 2, 1, 1, lead)
        plans |= {
            (*np.r_[matrix.states[i], matrix.actions[i], matrix.states[i + 1], matrix.actions[i + 1]].tolist(),)
            for i in range(matrix.calls)
        }
    assert rows == plans
    assert set(states[:, -1].tolist()) <= set(ddim_levels(CONFIG.levels, 2).tolist())


def test_a_student_comes_nearer_to_two_steps_of_its_teacher() -> None:
    torch.manual_seed(0)
    teacher, student = Denoiser(CONFIG).eval().requires_grad_(False), Denoiser(CONFIG)
    student.load_state_dict(teacher.state_dict())
    optimiser = torch.optim.Adam(student.parameters(), 3e-3)
    generator = torch.Generator().manual_seed(1)
    objective, seen = TrainingObjective(inference_delay=1), []
    for _ in range(60):
        window = (
            torch.randn(32, len(CONFIG.state_ticks), 3, generator=generator),
            torch.randn(32, len(CONFIG.action_ticks), 2, generator=generator),
            None,
        )
        loss = sum(distilled_losses(student, teacher, window, SIGNAL, generator, objective, 2))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        seen.append(float(loss.detach()))
    assert np.mean(seen[-10:]) < 0.6 * np.mean(seen[:10])
    assert not any(parameter.requires_grad for parameter in teacher.parameters())
