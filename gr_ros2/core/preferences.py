"""What GNU Radio keeps in the home directory: its preferences, and what FFTW has learnt about this processor.

Invariants: nothing is tried where the home directory can be written, which is the common case. Where it cannot,
versions of GNU Radio differ in what they need, so the answer comes from a small flowgraph in a separate process. GNU
Radio is not imported here: where it may not look into the home directory, its libraries end the process as they load.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from gr_ros2.core.errors import PhyError

TRIAL = """
from gnuradio import blocks, fft, gr
fft.fft_vcc(64, True, (), True)
top = gr.top_block()
top.connect(blocks.null_source(8), blocks.head(8, 64), blocks.null_sink(8))
top.run()
"""
"""A program that makes GNU Radio read and write everything that it keeps; it fails where that cannot be done."""


def _home() -> Path:
    return Path(os.environ.get("HOME") or Path.home())


def _refused(home: Path, what: str, why: str) -> PhyError:
    return PhyError(
        f"HOME = {home} cannot be {what}, and GNU Radio keeps its preferences there ({why}); set HOME to a "
        "folder of yours, for example HOME=/var/tmp/gr-ros2 after mkdir /var/tmp/gr-ros2"
    )


def check_home() -> None:
    """Check that GNU Radio may look for what it keeps, before it is imported.

    :raises PhyError: with the remedy, when it may not
    """
    folder = Path(os.environ.get("XDG_CONFIG_HOME") or _home() / ".config") / "gnuradio"
    try:
        folder.stat()
    except PermissionError as error:
        raise _refused(_home(), "read", str(error)) from error
    except OSError:
        return


def check_preferences() -> None:
    """Check that GNU Radio can write what it keeps.

    :raises PhyError: with the remedy, when a flowgraph would fail because it cannot
    """
    home = _home()
    if home.is_dir() and os.access(home, os.W_OK | os.X_OK):
        return
    done = subprocess.run([sys.executable, "-c", TRIAL], stdin=subprocess.DEVNULL, capture_output=True, check=False)
    if done.returncode:
        said = (done.stderr.decode("utf-8", "replace").strip().splitlines() or ["it ended without a word"])[-1]
        raise _refused(home, "written", said)
