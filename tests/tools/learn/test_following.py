"""What a network follows of what it is told, in many worlds at once."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from servoid.hw.robot.description import load_robot
from servoid.policy.checkpoint import Origin
from servoid.policy.diffusion.model.checkpoint import Trained, save
from servoid.policy.diffusion.model.config import DenoiserConfig
from servoid.policy.diffusion.model.denoiser import Denoiser
from servoid.policy.features import Normaliser
from servoid.policy.text.captions import NAMES
from servoid.policy.text.encoder import code_size
from servoid.stack.skills.skill import load_skills
from servoid.tools.learn.following import Followed, sentences_followed

ROBOT = load_robot()


def test_shares_are_of_what_was_asked_for() -> None:
    found = Followed()
    for motion, done, fell in ((0, True, False), (0, True, False), ("wave", True, False), ("bow", False, True)):
        found.count(motion, done, fell)
    assert found.share() == 0.75
    assert found.share({"wave": 0, "bow": 0}) == 0.5
    assert found.fell == {NAMES[0]: 0, "wave": 0, "bow": 1}


@pytest.mark.slow
def test_a_network_that_knows_nothing_is_told_and_follows_nearly_nothing(tmp_path: Path) -> None:
    """It holds the pose that it stands in, which is what a sentence to stand asks for, and no other."""
    torch.manual_seed(0)
    config = DenoiserConfig(54, 20, "words", code_size("words") + 4, width=16, heads=2, clock=2, horizon=8)
    home, ones = torch.zeros(20) + torch.from_numpy(ROBOT.home).float(), torch.ones(20)
    network = Denoiser(config)
    torch.nn.init.zeros_(network.head_action.weight)
    torch.nn.init.zeros_(network.head_action.bias)
    skills = {name: skill.phrases for name, skill in load_skills(ROBOT).items() if skill.alone}
    units = Normaliser(torch.zeros(54), torch.ones(54)), Normaliser(home, ones)
    trained = Trained(network.state_dict(), config, *units, skills=skills)
    save(tmp_path / "held.safetensors", trained, ROBOT, Origin("made up", "Apache-2.0", {}, {"inference_delay": 1}))
    found = sentences_followed(tmp_path / "held.safetensors", 8.0, 8, 0)
    assert found["survival"] == 1.0
    assert found["followed_skills"] == 0.0
    assert found["followed"] < 0.3
