"""The example in the workers' README runs, as it stands there."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
from processes import processes

README = Path(__file__).parents[2] / "workers" / "README.md"


def test_a_filter_front_end(tmp_path: Path) -> None:
    (program,) = re.findall(r"^```python\n(.*?)^```$", README.read_text(), re.M | re.S)
    with processes(tmp_path) as start:
        service = start("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--no-warm")
        (endpoint,) = service.ready()
        assert "tcp/127.0.0.1:7447" in program
        said = subprocess.run(
            [sys.executable, "-c", program.replace("tcp/127.0.0.1:7447", endpoint)],
            capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip
    assert said.returncode == 0, said.stderr
    first, second, third = said.stdout.splitlines()
    assert first == "the state has 31 numbers, made by in-place"
    angles, block = (np.array(re.findall(r"-?\d+\.\d+(?:e-?\d+)?", line), float) for line in (second, third))
    np.testing.assert_allclose(angles, [-0.55, 0.33], atol=0.05)
    assert block.size == 4
