"""Plan with a diffusion policy that `servoid onnx` wrote: numpy and ONNX Runtime, neither Servoid nor torch.

servoid onnx diffusion --out runs/onnx && python docs/onnx_policy.py runs/onnx
"""

import sys
from pathlib import Path

import numpy as np
import onnxruntime


class Policy:
    def __init__(self, folder: Path) -> None:
        self.saved = dict(np.load(folder / "policy.npz"))
        self.network = onnxruntime.InferenceSession(folder / "denoiser.onnx", providers=["CPUExecutionProvider"])
        self.reads = {entry.name for entry in self.network.get_inputs()}

    def plan(self, history: np.ndarray, ran: np.ndarray, noise: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Joint targets (ticks, n_joints) rad from this tick on: of states (history, 13 + 2 n_joints), the last now,
        of targets that ran before and run meanwhile, and of random numbers from a normal distribution."""
        s = self.saved
        given = {"states": self.seen(history), "actions": ran}
        window = {}
        for name, start in zip(given, noise, strict=True):  # what is known is clean, and the rest is noise
            known = np.zeros_like(start)
            known[: len(given[name])] = given[name] @ s[f"{name}_encode"] + s[f"{name}_encode_0"]
            window[name] = np.where(s[f"known_{name}"][:, None], known, start).astype(np.float32)
        told = {"text": s.get("text", s.get("untold")), "text_mask": np.array("text" in s)}
        for call in range(len(s["states_levels"])):
            levels = {"state_levels": s["states_levels"][call], "action_levels": s["actions_levels"][call]}
            inputs = {name: value[None] for name, value in (window | levels | told).items() if name in self.reads}
            clean = self.network.run(["clean_states", "clean_actions"], inputs)
            for name, found in zip(window, clean, strict=True):
                signal, noisy, signal_after, noisy_after = s[f"{name}_factors"][call][..., None]
                step = signal_after * found[0] + noisy_after * (window[name] - signal * found[0]) / noisy
                window[name] = np.where(s[f"{name}_goes_on"][call][:, None], step, window[name]).astype(np.float32)
        first = int(s["planned_from"])
        planned = window["actions"][first : first + int(s["planned_ticks"])]
        return planned @ s["actions_decode"] + s["actions_decode_0"]

    @staticmethod
    def seen(history: np.ndarray) -> np.ndarray:
        """States from where the robot is and heads now. A row: displacement 3, yaw 1, and what stays as it is."""
        moved, yaw = history[:, :2] - history[-1, :2], history[:, 3] - history[-1, 3]
        c, s = np.cos(-history[-1, 3]), np.sin(-history[-1, 3])
        x, y = c * moved[:, 0] - s * moved[:, 1], s * moved[:, 0] + c * moved[:, 1]
        return np.column_stack([x, y, np.cos(yaw), np.sin(yaw), history[:, 2], history[:, 4:]])


if __name__ == "__main__":
    policy = Policy(Path(sys.argv[1]))
    names = ("history", "ran", "noise_states", "noise_actions", "planned")
    history, ran, *noise, reference = (policy.saved[f"example_{name}"] for name in names)
    planned = policy.plan(history, ran, tuple(noise))
    for joint, target in zip(policy.saved["joints"], planned[0], strict=True):
        print(f"{joint:12s} {target:7.3f} rad")
    print(f"torch's plan differs by {np.abs(planned - reference).max():.1e} rad at most")
