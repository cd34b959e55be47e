"""The kernels on 64-bit ARM: cross-compiled, run by an emulator, compared with numpy here."""

from __future__ import annotations

import ast
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gr_ros2.phy.burst import BurstModem, ModemConstants, Samples
from gr_ros2.phy.kernels.modem import KERNELS
from tests.once import once
from tests.phy.kernels.support import IDS, SETTINGS, make
from tests.phy.test_burst import bursts, noise
from tests.phy.test_burst import received_by as received

ROOT = Path(__file__).resolve().parents[3]
COMPILER, EMULATOR = "aarch64-linux-gnu-g++", "qemu-aarch64"
EXACT = 1e-3
_TYPES = {"int32": np.dtype("<i4"), "float64": np.dtype("<f8")}


def flags() -> list[str]:
    """What setup.py compiles with, but for the longest half of the optimiser's work."""
    tree = ast.parse((ROOT / "setup.py").read_text("utf-8"))
    (given,) = (node.value for node in tree.body if isinstance(node, ast.Assign) and names(node) == ["COMPILE"])
    return [flag.replace("-O3", "-O2") for flag in ast.literal_eval(given)]


def names(node: ast.Assign) -> list[str]:
    return [ast.unparse(target) for target in node.targets]


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The command that runs the kernels on ARM."""
    emulator = shutil.which(EMULATOR) or shutil.which(f"{EMULATOR}-static")
    if shutil.which(COMPILER) is None or emulator is None:
        pytest.skip("needs a compiler for ARM and an emulator: apt install g++-aarch64-linux-gnu qemu-user")
    return [emulator, str(once(tmp_path_factory, "arm", build) / "replay")]


def build(folder: Path) -> None:
    sources = [*sorted((ROOT / "gr_ros2" / "phy" / "kernels").glob("*.cpp")), Path(__file__).parent / "replay.cpp"]
    subprocess.run([COMPILER, *flags(), "-static", *map(str, sources), "-o", str(folder / "replay")], check=True)


def written(path: Path, constants: ModemConstants, samples: Samples) -> None:
    """The file that ``replay.cpp`` reads."""
    kind, fields = KERNELS[constants.kernel]
    numbers, arrays = b"", []
    for name, type_name in fields.items():
        value = constants.values[name]
        if type_name in _TYPES:
            one = _TYPES[type_name]
            numbers += bytes(-len(numbers) % one.itemsize) + np.array(value, one).tobytes()
        else:
            arrays.append(np.ascontiguousarray(value, type_name.removesuffix("s")).tobytes())
    numbers += bytes(-len(numbers) % 8)
    head = [kind, len(numbers), len(arrays), len(samples), constants.soft_bits, constants.points]
    parts = [np.array(head, "<i8").tobytes(), numbers]
    for array in arrays:
        parts += [np.array(len(array), "<i8").tobytes(), array]
    path.write_bytes(b"".join([*parts, samples.tobytes()]))


def test_it_is_compiled_for_neon(arm: list[str]) -> None:
    assert subprocess.run(arm, capture_output=True, text=True, check=True).stdout.strip() == "NEON"


@pytest.mark.parametrize(("name", "options"), SETTINGS, ids=IDS)
def test_same_as_numpy(name: str, options: dict[str, Any], arm: list[str], tmp_path: Path) -> None:
    phy = make(name, options)
    modem: BurstModem = phy.modem
    packets, samples = bursts(phy, 1)
    turned = samples * np.exp(2j * np.pi * 0.003 * np.arange(len(samples)))
    stream = received(phy, turned + noise(len(samples), 30) * phy.burst_power() ** 0.5)
    constants = modem.constants()
    assert constants is not None
    written(tmp_path / "burst", constants, stream)
    out = subprocess.run([*arm, str(tmp_path / "burst")], capture_output=True, check=True).stdout
    searched, start, read = np.frombuffer(out, "<i8", 3).tolist()
    snr = float(np.frombuffer(out, "<f8", 1, 24)[0])
    told = np.frombuffer(out, "<i8", 5, 32).tolist()
    soft = np.frombuffer(out, "<f4", told[2], 72)
    found = modem.find(stream)
    assert found.start is not None
    wanted = modem.read(stream, found.start)
    assert wanted is not None
    assert wanted.soft is not None
    assert (searched, start, read) == (found.searched, found.start, 1)
    assert told == [wanted.end, wanted.length, len(wanted.soft), len(wanted.points), wanted.mcs]
    assert snr == pytest.approx(wanted.snr, rel=EXACT)
    assert np.abs(soft - wanted.soft).max() <= EXACT * float(np.abs(wanted.soft).mean())
    assert phy.modem.frames.of(wanted.length).unwrap(soft) == packets[0]
