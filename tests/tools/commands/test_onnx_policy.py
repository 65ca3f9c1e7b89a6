"""What `servoid onnx` writes plans without torch and without Servoid, as torch does."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from servoid.tools import cli

ROOT = Path(__file__).resolve().parents[3]
REFUSING = """
import runpy, sys
sys.modules["torch"] = sys.modules["servoid"] = None  # whoever imports them fails
sys.argv = ["onnx_policy.py", {folder!r}]
runpy.run_path({example!r}, run_name="__main__")
"""


@pytest.mark.slow
def test_the_example_plans_without_torch(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    folder, example = tmp_path / "onnx", ROOT / "docs" / "onnx_policy.py"
    assert cli.main(["onnx", "diffusion", "--text", "turn left", "--out", str(folder)]) == 0
    code = REFUSING.format(folder=str(folder), example=str(example))
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    apart = re.search(r"differs by (\S+) rad", run.stdout)
    assert apart is not None
    assert float(apart[1]) < 1e-4
    assert len(example.read_text().splitlines()) <= 60
    capsys.readouterr()
    assert cli.main(["onnx", "diffusion", "--out", str(folder), "--json"]) == 2
    assert "already exists: use --replace" in json.loads(capsys.readouterr().out)["error"]


@pytest.mark.parametrize(
    ("policy", "said"),
    [
        ("diffuse_cloc", "schedule must be another than rolling"),
        ("diffuson", "did you mean 'diffusion'"),
        ("expert.safetensors", "no such checkpoint"),
    ],
)
def test_what_cannot_be_exported_is_refused(
    policy: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("onnxscript")
    assert cli.main(["onnx", policy, "--out", str(tmp_path / "onnx"), "--json"]) == 2
    assert said in json.loads(capsys.readouterr().out)["error"]
    assert not (tmp_path / "onnx").exists()
