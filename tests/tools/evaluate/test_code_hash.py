"""Episodes and clips are kept by the code that made and judged them."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from servoid.tools.evaluate import clips
from servoid.tools.evaluate.cache import key
from servoid.tools.evaluate.code_hash import digest
from servoid.tools.evaluate.policies import Policies, dependencies
from servoid.tools.evaluate.spec import Experiment


@pytest.mark.parametrize(
    "name",
    [
        "hw/robot/legs.py",
        "sim/rig/servo/virtual_servo.py",
        "policy/diffusion/sampler.py",
        "stack/control/planning/trim.py",
        "configs/servos/xm430-w350.yaml",
        "tools/common/ground_truth.py",
        "tools/common/motion_quality.py",
        "tools/evaluate/judge.py",
        "tools/evaluate/episode.py",
    ],
)
def test_the_hash_of_the_code_changes_with_all_that_makes_or_judges_a_run(tmp_path: Path, name: str) -> None:
    """Else an evaluation after a change goes on with episodes from before it."""
    root = Path(__file__).resolve().parents[3]
    for part in ("hw", "sim", "policy", "stack", "configs", "tools"):
        shutil.copytree(root / part, tmp_path / part, ignore=shutil.ignore_patterns("__pycache__", "*.safetensors"))
    before = digest(tmp_path)
    assert before == digest(tmp_path)
    (tmp_path / "tools" / "plot.py").write_text("# how pictures look\n")
    (tmp_path / "policy" / "checkpoints" / "other.safetensors").parent.mkdir(exist_ok=True)
    (tmp_path / "policy" / "checkpoints" / "other.safetensors").write_bytes(b"one that no row uses")
    (tmp_path / "configs" / "evaluation" / "mine.yaml").write_text("title: another evaluation\n")
    assert digest(tmp_path) == before
    with (tmp_path / name).open("a") as file:
        file.write("# changed\n")
    assert digest(tmp_path) != before


def test_changed_code_changes_what_episodes_and_clips_depend_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    near, policies = Experiment("goal-near"), Policies("gait", tmp_path)

    def keys() -> tuple[str, str]:
        return key(dependencies(near, policies, "op3", 0, None, None)), key(clips.recipe("op3"))

    before = keys()
    monkeypatch.setattr("servoid.tools.evaluate.cache.code", lambda: "other")
    monkeypatch.setattr("servoid.tools.evaluate.clips.code", lambda: "other")
    assert not set(before) & set(keys())
