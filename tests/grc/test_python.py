"""After --install the blocks work in GNU Radio's programs as anybody starts them; --uninstall takes it back."""

from __future__ import annotations

import html
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from gr_ros2.core.errors import ConfigError
from gr_ros2.grc import python as grc_python
from gr_ros2.grc.path import example
from gr_ros2.grc.path import grc_path as block_folder
from gr_ros2.grc.python import MODULE, PATH_FILE, OtherPython, ask, finds_us, grc_program, provide, withdraw
from gr_ros2.middleware import Qos
from gr_ros2.middleware.dds import DdsMiddleware
from tests.domains import free_domains
from tests.waiting import PATIENCE_S, wait_for

ROOT = Path(__file__).resolve().parents[2]
GRCC = Path("/usr/bin/grcc")
GRC = Path("/usr/bin/gnuradio-companion")
GRC_CACHE = Path.home() / ".cache" / "grc_gnuradio"
BLOCKS = block_folder()
ODOM = "nav_msgs/Odometry"
KEY_S = 5.0
"""s until a key is pressed again. The window of GNU Radio 3.10.12 runs a flowgraph as often as it is asked."""
F6, F7 = "72", "73"
"""Key codes. By their names, xdotool also presses Alt where the keyboard map (xkb-data 2.46) names these keys there
first."""


def plain(home: Path, **more: str) -> dict[str, str]:
    """The environment of a shell in which nothing of ours is known."""
    return {"HOME": str(home), "PATH": "/usr/bin:/bin", "LANG": "C.UTF-8", "ROS_LOCALHOST_ONLY": "1", **more}


def grc_path(home: Path, option: str) -> subprocess.CompletedProcess[str]:
    environ = {**plain(home), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "gr_ros2.cli", "grc-path", option]
    return subprocess.run(command, env=environ, capture_output=True, text=True, cwd=home)


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A home folder in which --install was called. Where GRC finds no cache, it reads its descriptions for 6 s."""
    if not GRCC.is_file():
        pytest.skip("needs GNU Radio's grcc in /usr/bin")
    if GRC_CACHE.is_dir():
        shutil.copytree(GRC_CACHE, tmp_path / ".cache" / GRC_CACHE.name)
    done = grc_path(tmp_path, "--install")
    if "make its environment by" in done.stderr:
        pytest.skip(f"these tests run in another Python than GNU Radio: {done.stderr.strip()}")
    assert done.returncode == 0, done.stderr
    return tmp_path


def on_own_domains(name: str, home: Path) -> tuple[Path, list[int]]:
    """A copy of an example, and its two domains."""
    domains = free_domains()
    path = home / name
    text = example(name).read_text()
    for ours, number in zip(("'41'", "'42'"), domains, strict=True):
        text = text.replace(f"value: {ours}", f"value: '{number}'").replace(
            f"domain_id: {ours}", f"domain_id: '{number}'"
        )
    path.write_text(text)
    return path, domains


@pytest.fixture
def flowgraph(home: Path) -> tuple[Path, list[int]]:
    """An example on two domains of its own."""
    return on_own_domains("psk_loopback.grc", home)


def carries(domains: list[int], runs: Callable[[], bool], log: Path) -> None:
    """Wait until a message crosses the flowgraph that runs elsewhere. One that has ended is not waited for.

    :param log: what the flowgraph says
    """
    heard: list[bytes] = []
    said = b"\0\1\0\0" + bytes(720)
    with (
        DdsMiddleware(domain_id=domains[0], localhost_only=True) as one,
        DdsMiddleware(domain_id=domains[1], localhost_only=True) as two,
    ):
        two.subscribe("/rx_robot_1/odom", ODOM, Qos(depth=0), heard.append)
        publisher = one.advertise("/robot_1/odom", ODOM, Qos(depth=1))

        def found() -> bool:
            assert runs(), f"the flowgraph has ended: {log.read_text()}"
            return publisher.matched()

        wait_for(found, "the flowgraph to find the publisher")
        wait_for(lambda: found() and (publisher.publish(said) or heard), "a message on the other side")
    assert heard[0] == said


@pytest.mark.slow
def test_plain_grcc_and_plain_python(home: Path, flowgraph: tuple[Path, list[int]]) -> None:
    path, domains = flowgraph
    done = subprocess.run([GRCC, "-o", home, path], env=plain(home), capture_output=True, text=True, cwd=home)
    assert done.returncode == 0, done.stdout + done.stderr
    program = home / "psk_loopback.py"
    command = ["/usr/bin/python3", str(program)]
    with (home / "log").open("w") as log:
        running = subprocess.Popen(command, env=plain(home), stdin=subprocess.PIPE, stdout=log, stderr=log, cwd=home)
    try:
        carries(domains, lambda: running.poll() is None, home / "log")
    finally:
        running.send_signal(signal.SIGINT)
        running.wait(PATIENCE_S)
    assert "Traceback" not in (home / "log").read_text()

    assert finds_us("/usr/bin/python3", plain(home))
    assert grc_path(home, "--uninstall").returncode == 0
    assert not finds_us("/usr/bin/python3", plain(home))
    left = [path for path in home.rglob("*") if path.name in (PATH_FILE, "config.conf") or MODULE in path.name]
    assert left == []
    again = subprocess.run(command, env=plain(home), stdin=subprocess.DEVNULL, capture_output=True, text=True)
    assert "No module named 'gr_ros2'" in again.stderr


@pytest.mark.slow
def test_nothing_of_the_system_is_shadowed(home: Path) -> None:
    """Every module of every distribution of the system comes from where it came from before."""
    program = (
        "from importlib import metadata, util\n"
        "names = [name for name in metadata.packages_distributions() if name.isidentifier()]\n"
        "print(sorted((n, str(s.origin)) for n in names if (s := util.find_spec(n)) is not None))\n"
        "print(sorted((d.metadata['Name'], d.version) for d in metadata.distributions()))"
    )

    def found(where: Path) -> str:
        command = ["/usr/bin/python3", "-c", program]
        return subprocess.run(command, env=plain(where), capture_output=True, text=True, check=True).stdout

    empty = home / "empty"
    empty.mkdir()
    assert found(home) == found(empty)


def test_once_more_changes_nothing_and_back_again_twice_neither(home: Path) -> None:
    files = {path: path.read_text() for path in home.rglob("*") if path.suffix in (".pth", ".py", ".conf")}
    assert len(files) == 3
    assert grc_path(home, "--install").returncode == 0
    assert {path: path.read_text() for path in files} == files
    assert "taken back: " in grc_path(home, "--uninstall").stderr
    assert "nothing was there" in grc_path(home, "--uninstall").stderr


def this_python(tmp_path: Path) -> OtherPython:
    other = ask(sys.executable)
    return replace(other, user=tmp_path / "site-packages", where="", enabled=True)


def test_a_python_that_cannot_have_it_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    other = this_python(tmp_path)
    with pytest.raises(ConfigError, match=r"runs in Python 3\.8 .*; make its environment by .* -m venv --system-site"):
        provide(replace(other, version=(3, 8)))
    with pytest.raises(ConfigError, match=r"does not look into .*; set PYTHONPATH="):
        provide(replace(other, enabled=False))
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "in-the-way").write_text("")
    with pytest.raises(ConfigError, match=r"in-the-way.*cannot be written"):
        provide(replace(other, user=tmp_path / "in-the-way" / "site-packages"))
    with pytest.raises(ConfigError, match=r"nowhere.*does not run"):
        ask(str(tmp_path / "nowhere"))


def test_a_python_that_finds_us_by_itself_needs_nothing(tmp_path: Path) -> None:
    assert provide(replace(this_python(tmp_path), where=str(ROOT))) is None


def test_only_what_blocks_need_is_offered(tmp_path: Path) -> None:
    other = replace(this_python(tmp_path), has={"numpy": "1.24.2", "pydantic": "1.10"})
    path_file = provide(other)
    assert path_file is not None
    text = path_file.read_text()
    assert "'pydantic'" in text  # there it is too old
    assert "'matplotlib'" not in text
    assert "'pytest'" not in text
    assert withdraw(other) == [path_file, path_file.with_name(f"{MODULE}.py")]


def test_which_python_grc_starts_in(tmp_path: Path) -> None:
    script = tmp_path / "grcc"
    for line, program in (
        (f"#!{sys.executable} -E", sys.executable),
        ("#!/usr/bin/env python3", "/usr/bin/python3"),
        ("#!/nowhere/python", "/usr/bin/python3"),
        ("no script", "/usr/bin/python3"),
    ):
        script.write_text(f"{line}\n")
        script.chmod(0o755)
        assert grc_program(str(tmp_path)) == program
    assert grc_program(str(tmp_path / "nothing")) == "/usr/bin/python3"
    assert set(grc_python.NEEDED) == {name.lower() for name in grc_python.NEEDED}


GTK = "import gi; [gi.require_version(*of) for of in (('Gtk', '3.0'), ('PangoCairo', '1.0'))]"


@pytest.fixture
def screen(tmp_path: Path) -> Iterator[tuple[str, Path]]:
    """A display without a monitor, and the file that has its pixels."""
    for program in ("Xvfb", "xdotool"):
        if shutil.which(program) is None:
            pytest.skip(f"needs {program}")
    if not GRC.is_file() or subprocess.run(["/usr/bin/python3", "-c", GTK], capture_output=True).returncode:
        pytest.skip("needs gnuradio-companion and Gtk 3 (gir1.2-gtk-3.0)")
    command = ["Xvfb", "-displayfd", "1", "-screen", "0", "1400x900x24", "-fbdir", str(tmp_path), "-nolisten", "tcp"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        assert server.stdout is not None
        yield f":{server.stdout.readline().strip()}", tmp_path / "Xvfb_screen0"
        server.terminate()


class Keyboard:
    """Looks for windows and presses keys.

    :param environ: names the display
    """

    def __init__(self, environ: Mapping[str, str]) -> None:
        self._environ = environ

    def run(self, *words: str) -> str:
        """What xdotool prints."""
        return subprocess.run(["xdotool", *words], env=self._environ, capture_output=True, text=True).stdout.strip()

    def window(self, title: str) -> str:
        """The first window that is shown with this in its title; '' while there is none."""
        return self.run("search", "--onlyvisible", "--name", title).partition("\n")[0]

    def opened(self, title: str) -> str:
        """That window, once it is there."""
        command = ["xdotool", "search", "--sync", "--onlyvisible", "--name", title]
        done = subprocess.run(command, env=self._environ, capture_output=True, text=True, timeout=PATIENCE_S)
        return done.stdout.partition("\n")[0]

    def press(self, window: str, key: str, until: Callable[[], object], what: str) -> None:
        """A key again and again, since a window takes none until it is ready; with time for what the key does."""
        again = 0.0

        def done() -> object:
            nonlocal again
            if until():
                return True
            if time.monotonic() > again:
                self.run("windowfocus", window)
                self.run("key", key)
                again = time.monotonic() + KEY_S
            return False

        wait_for(done, what)


def colours(pixels: Path) -> int:
    """How many different pixels a screen has."""
    data = pixels.read_bytes()
    return len(set(memoryview(data[len(data) % 4 :]).cast("I")))


@pytest.mark.slow
def test_the_window_explains_every_block_and_each_of_its_settings(home: Path, screen: tuple[str, Path]) -> None:
    """GRC writes the text over a field itself: key, type and value. Ours is on the page Documentation."""
    done = subprocess.run(
        ["/usr/bin/python3", ROOT / "tests" / "grc_texts.py"],
        env=plain(home, DISPLAY=screen[0]),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        cwd=home,
    )
    assert done.returncode == 0, done.stderr
    shown = json.loads(done.stdout.splitlines()[-1])
    blocks = {path.name.partition(".")[0]: yaml.safe_load(path.read_text()) for path in BLOCKS.glob("*.block.yml")}
    assert shown.keys() == blocks.keys()
    for name, block in blocks.items():
        texts, summary = shown[name], block["documentation"].splitlines()[0]
        assert html.unescape(texts["hover"]).startswith(summary), name
        assert texts["page"].startswith(summary), name
        explained = tuple(re.findall(r"^([^:\n]+): \S", texts["page"], re.MULTILINE))
        for parameter in block["parameters"]:
            assert parameter["label"] in texts["labels"], (name, parameter["label"])
            assert parameter["label"].partition(" (")[0].startswith(explained), (name, parameter["label"])
            assert any(text.startswith(f"Key: {parameter['id']}\n") for text in texts["hovers"]), parameter["id"]


@pytest.mark.slow
def test_the_window_draws_an_example_runs_it_and_closes(
    home: Path, flowgraph: tuple[Path, list[int]], screen: tuple[str, Path]
) -> None:
    path, domains = flowgraph
    display, pixels = screen
    started = home / "started"
    # GRC runs a flowgraph without a window in one, after -e: the command in one word, from 3.10.12 on in several.
    terminal = home / "terminal"
    terminal.write_text(
        f"#!/bin/sh\necho $$ > {started}.new\nmv {started}.new {started}\nshift\nexec $* >{started}.log 2>&1\n"
    )
    terminal.chmod(0o755)
    preferences = home / ".gnuradio" / "config.conf"
    preferences.write_text(f"{preferences.read_text()}xterm_executable = {terminal}\n")
    environ = plain(home, DISPLAY=display)
    keyboard = Keyboard(environ)
    empty = colours(pixels)
    with (home / "log").open("w") as log:
        command = [GRC, path]
        grc = subprocess.Popen(command, env=environ, stdin=subprocess.PIPE, stdout=log, stderr=log, cwd=home)
    try:
        window = keyboard.opened("psk_loopback.grc")
        wait_for(lambda: colours(pixels) > empty + 100, "blocks to be drawn")
        keyboard.press(window, F6, path.with_suffix(".py").is_file, "the flowgraph to be generated")
        wait_for(started.is_file, "the flowgraph to be run")
        process = Path("/proc") / started.read_text().strip()
        carries(domains, process.exists, started.with_suffix(".log"))
        said = subprocess.run(["gnuradio-config-info", "--version"], env=environ, capture_output=True, text=True)
        if said.stdout.startswith("3.10.12."):  # its window forgets what it runs, so F7 does nothing
            os.kill(int(process.name), signal.SIGTERM)
            wait_for(lambda: not process.exists(), "the flowgraph to end")
        else:
            keyboard.press(window, F7, lambda: not process.exists(), "the flowgraph to be stopped")
        keyboard.press(window, "ctrl+q", lambda: grc.poll() is not None, "the window to be closed")
        assert grc.returncode == 0
    finally:
        grc.kill()
        grc.wait()
    said = (home / "log").read_text()
    assert not re.search("Traceback|gr_ros2.*[Ee]rror", said), said


@pytest.mark.slow
def test_the_first_example_runs_on_the_play_button_in_a_window_of_its_own(home: Path, screen: tuple[str, Path]) -> None:
    """Its window opens and its robot's topics come out on the other graph; its end does not disturb GRC."""
    path, domains = on_own_domains("first_link.grc", home)
    display, pixels = screen
    environ = plain(home, DISPLAY=display, XDG_RUNTIME_DIR=str(home))
    preferences = home / ".gnuradio" / "config.conf"  # GRC asks whether there is one before it runs anything
    preferences.write_text(f"{preferences.read_text()}xterm_executable = /bin/false\n")
    keyboard = Keyboard(environ)
    empty = colours(pixels)
    heard: list[bytes] = []
    with (home / "log").open("w") as log:
        grc = subprocess.Popen([GRC, path], env=environ, stdin=subprocess.PIPE, stdout=log, stderr=log, cwd=home)
    try:
        window = keyboard.opened("first_link.grc")
        wait_for(lambda: colours(pixels) > empty + 100, "blocks to be drawn")
        title = "ROS topics over OFDM"
        keyboard.press(window, F6, lambda: keyboard.window(title), "the flowgraph's window")

        def large() -> bool:
            shape = re.search(r"Geometry: (\d+)x(\d+)", keyboard.run("getwindowgeometry", keyboard.window(title)))
            return shape is not None and int(shape[1]) >= 1000 and int(shape[2]) >= 800

        wait_for(large, "a window that has room for all of it")
        with DdsMiddleware(domain_id=domains[1], localhost_only=True) as graph:
            graph.subscribe("/rx_robot_1/odom", ODOM, Qos(depth=0), heard.append)
            wait_for(lambda: len(heard) > 10, "odometry of the simulated robot")
        said = (home / "log").read_text()
        assert not re.search("Traceback|gr_ros2.*[Ee]rror|terminal", said), said
        keyboard.run("windowkill", keyboard.window(title))  # no window manager is here that could close it
        wait_for(lambda: not keyboard.window(title), "the flowgraph's window to be closed")
        keyboard.press(window, "ctrl+q", lambda: grc.poll() is not None, "GRC to be closed")
        assert grc.returncode == 0
    finally:
        grc.kill()
        grc.wait()
