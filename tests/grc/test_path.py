"""GRC finds the blocks after --install, whatever stood in the preferences before."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.grc import path as grc_path

FOLDER = "/opt/gr-ros2/grc"


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("", f"[grc]\nlocal_blocks_path = {FOLDER}\n"),
        ("[log]\nlevel = info", f"[log]\nlevel = info\n\n[grc]\nlocal_blocks_path = {FOLDER}\n"),
        ("[grc]\nfont = 8\n", f"[grc]\nlocal_blocks_path = {FOLDER}\nfont = 8\n"),
        ("[grc]\nlocal_blocks_path =\n[x]\n", f"[grc]\nlocal_blocks_path = {FOLDER}\n[x]\n"),
        ("[GRC]\nlocal_blocks_path=/a:/b\n# end\n", f"[GRC]\nlocal_blocks_path = /a:/b:{FOLDER}\n# end\n"),
        ("[x]\nlocal_blocks_path = /a\n", f"[x]\nlocal_blocks_path = /a\n\n[grc]\nlocal_blocks_path = {FOLDER}\n"),
        ('[grc]\nlocal_blocks_path = "/a b"\n', f'[grc]\nlocal_blocks_path = "/a b:{FOLDER}"\n'),
    ],
)
def test_the_folder_is_added_and_the_rest_kept(before: str, after: str) -> None:
    assert grc_path.with_blocks_path(before, FOLDER) == after
    assert grc_path.with_blocks_path(after, FOLDER) == after


@pytest.mark.parametrize(
    "before",
    [
        "",
        "[log]\nlevel = info\n",
        "[grc]\nfont = 8\n",
        "[GRC]\nlocal_blocks_path = /a:/b\n# end\n",
        "[x]\nlocal_blocks_path = /a\n",
        '[grc]\nlocal_blocks_path = "/a b"\n',
        "[log]\nlevel = info\n\n[grc]\nfont = 8\n\n[x]\ny = 1\n",
    ],
)
def test_the_folder_is_taken_out_again_and_the_rest_kept(before: str) -> None:
    after = grc_path.with_blocks_path(before, FOLDER)
    assert grc_path.without_blocks_path(after, FOLDER) == before
    assert grc_path.without_blocks_path(before, FOLDER) == before


def test_which_files(tmp_path: Path) -> None:
    home = {"HOME": str(tmp_path)}
    old = tmp_path / ".gnuradio" / "config.conf"
    assert grc_path.preference_files(home) == [old]
    new = tmp_path / ".config" / "gnuradio"
    new.mkdir(parents=True)
    assert grc_path.preference_files(home) == [old, new / "config.conf"]
    assert grc_path.preference_files({**home, "GR_PREFS_PATH": "/p"}) == [Path("/p/config.conf")]


def test_gnu_radio_itself_reads_what_was_installed(tmp_path: Path) -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    (tmp_path / ".gnuradio").mkdir()
    (tmp_path / ".gnuradio" / "config.conf").write_text("[grc]\ncanvas_font_size = 11\n")
    environ = {**os.environ, "HOME": str(tmp_path)}
    for name in ("GRC_BLOCKS_PATH", "GR_PREFS_PATH", "XDG_CONFIG_HOME"):
        environ.pop(name, None)
    assert grc_path.install(environ) == tmp_path / ".gnuradio" / "config.conf"
    once = (tmp_path / ".gnuradio" / "config.conf").read_text()
    grc_path.install(environ)
    assert (tmp_path / ".gnuradio" / "config.conf").read_text() == once
    program = (
        "from gnuradio import gr\n"
        "print(gr.prefs().get_string('grc', 'local_blocks_path', ''))\n"
        "print(gr.prefs().get_long('grc', 'canvas_font_size', 0))\n"
    )
    out = subprocess.run([sys.executable, "-c", program], env=environ, capture_output=True, text=True, check=True)
    assert out.stdout.split() == [str(grc_path.grc_path()), "11"]


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / ".gnuradio").write_text("in the way")
    with pytest.raises(ConfigError, match="GRC_BLOCKS_PATH"):
        grc_path.install({"HOME": str(tmp_path)})


def test_examples_are_found_by_name() -> None:
    assert grc_path.example("topics.csv").is_file()
    with pytest.raises(ConfigError, match="nope"):
        grc_path.example("nope.csv")
