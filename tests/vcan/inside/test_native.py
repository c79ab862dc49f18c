"""The other way to vcan, a network namespace of this kernel, tried where there is a kernel that can."""

from pathlib import Path

from tests.vcan import uml
from tests.vcan.conftest import CACHE
from tests.vcan.inside.peers import program


def test_namespace_of_its_own_has_interfaces_of_its_own(tmp_path: Path) -> None:
    """What is sent on vcan0 in there is not seen out here, and comes back from in there whole."""
    assert uml.native_vcan_available()
    program("candump")
    script = "candump -L -n1 vcan0 & while ! cansend vcan0 001#07 || [ -d /proc/$! ]; do sleep 0.02; done; exit 4"
    code, text = uml.run(["sh", "-c", script], tmp_path, 30, cache=CACHE, native=True)
    assert code == 4
    assert text.endswith(") vcan0 001#07\n")
    assert list(tmp_path.iterdir()) == []
