"""The container image of a robot's link: it is built and run where docker or podman works; elsewhere what it is made of
is compared with what there is."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.waiting import wait_for

ROOT = Path(__file__).resolve().parents[1]
BUILD_S = 3600.0
"""s that a build may take, which fetches GNU Radio."""
KNOWN = {"FROM", "ARG", "ENV", "RUN", "COPY", "WORKDIR", "USER", "VOLUME", "ENTRYPOINT", "CMD"}


def instructions() -> list[tuple[str, str]]:
    """Name and rest of each, continued lines joined."""
    text = re.sub(r"^#.*\n", "", (ROOT / "Dockerfile").read_text(), flags=re.MULTILINE).replace("\\\n", " ")
    return [(line.split()[0], line.partition(" ")[2].strip()) for line in text.splitlines() if line.strip()]


def stages() -> dict[str, list[tuple[str, str]]]:
    """Instructions of each stage, by its name; the last has none, which stands for ''."""
    found: dict[str, list[tuple[str, str]]] = {}
    for name, rest in instructions():
        if name == "FROM":
            _, _, stage = rest.partition(" AS ")
            current = found[stage] = []
        current.append((name, rest))
    return found


def copied() -> list[tuple[list[str], str]]:
    """What comes from this repository, and where it goes."""
    words = [rest.split() for name, rest in instructions() if name == "COPY" and not rest.startswith("--from=")]
    return [(sources, target) for *sources, target in words]


def test_every_instruction_is_one_and_each_stage_begins_from_another() -> None:
    assert {name for name, _ in instructions()} <= KNOWN
    known = {"ubuntu:24.04"}
    for stage, body in stages().items():
        assert body[0][0] == "FROM"
        assert body[0][1].split()[0] in known
        assert {rest.split()[0].removeprefix("--from=") for _, rest in body if rest.startswith("--from=")} <= known
        known.add(stage)
    for name, rest in instructions():
        if name == "RUN":
            assert subprocess.run(["sh", "-n"], input=rest, text=True, check=False).returncode == 0
        if name in ("ENTRYPOINT", "CMD"):
            assert json.loads(rest)


def test_it_runs_as_a_user_of_its_own_who_owns_the_state() -> None:
    last = dict(stages()[""])
    (made,) = (rest for name, rest in stages()[""] if name == "RUN")
    assert f"useradd --uid 1000 --groups audio,dialout,plugdev --home-dir {last['VOLUME']} --create-home" in made
    assert made.split()[-1] == last["USER"] != "root"
    assert last["WORKDIR"] == last["VOLUME"]


def test_it_installs_what_the_debian_package_needs_and_nothing_else() -> None:
    control = (ROOT / "debian" / "control").read_text()
    robot = control.split("Package: gr-ros2\n")[1].split("Recommends:")[0].partition("Depends:")[2]
    needed = {name.split()[0] for name in robot.split(",") if "$" not in name}
    builds = {name.split()[0] for name in control.split("Build-Depends:")[1].split("Standards")[0].split(",")}

    def installed(stage: str) -> set[str]:
        (command,) = (rest for name, rest in stages()[stage] if name == "RUN" and "apt-get install" in rest)
        words = shlex.split(command.partition("apt-get install")[2].partition("&&")[0])
        return {word for word in words if not word.startswith(("-", "$"))}

    # What makes a user, and the libraries of C and C++, are in every image of the distribution or come with GNU Radio.
    assert installed("base") == needed - {"adduser", "libc6", "libstdc++6"}
    assert installed("build") - {"build-essential"} <= builds


def test_what_it_takes_is_not_ignored_and_suffices_to_build(tmp_path: Path) -> None:
    taken = [source for sources, _ in copied() for source in sources]
    kept = [line[1:] for line in (ROOT / ".dockerignore").read_text().split() if line.startswith("!")]
    assert sorted(taken) == sorted(kept)
    for sources, target in copied():
        for source in sources:
            if (ROOT / source).is_dir():
                shutil.copytree(ROOT / source, tmp_path / target, ignore=shutil.ignore_patterns("*.so", "__pycache__"))
            else:
                shutil.copy(ROOT / source, tmp_path / target)
    build = [sys.executable, "setup.py", "--quiet", "build_py", "install_data", "--install-dir", "there"]
    done = subprocess.run(build, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "there/share/gr_ros2/package.xml").is_file()
    (packages,) = tmp_path.glob("build/lib*")
    modules = {path.relative_to(packages) for path in packages.rglob("*.py")}
    assert modules == {path.relative_to(ROOT) for path in (ROOT / "gr_ros2").rglob("*.py")}


def engine() -> str:
    """docker or podman, if it works here."""
    for name in ("docker", "podman"):
        if shutil.which(name) and subprocess.run([name, "info"], capture_output=True, check=False).returncode == 0:
            return name
    pytest.skip("neither docker nor podman works here")


@pytest.mark.slow
def test_the_image_builds_runs_a_link_and_ends_it(tmp_path: Path) -> None:
    program = engine()
    (tmp_path / "robot.yaml").write_text(
        "robot: 1\ntopics: [odom]\ngraph: {middleware: memory}\nphy: {name: modem}\n"
        "front_end: {name: udp, listen: '127.0.0.1:5000', send_to: ['127.0.0.1:5001']}\n"
    )
    tmp_path.chmod(0o755)

    def ask(*words: str) -> str:
        done = subprocess.run([program, *words], capture_output=True, text=True, check=False, timeout=BUILD_S)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    image = ask("build", "--quiet", str(ROOT)).splitlines()[-1]
    assert "self-test" in ask("run", "--rm", image, "doctor", "--help")
    container = ask("run", "--detach", "--volume", f"{tmp_path}:/etc/gr-ros2:ro", image)
    try:
        wait_for(lambda: "robot 1 on udp" in ask("logs", container), "the link", longest_s=1.0)
        assert ask("exec", container, "id", "--user") == "1000"
        (row,) = json.loads(ask("exec", container, "gr-ros2", "top", "--json"))
        assert row["robot"] == 1
        ask("stop", container)
        assert ask("inspect", "--format", "{{.State.ExitCode}}", container) == "0"
        assert "nobody heard" in ask("logs", container)
    finally:
        ask("rm", "--force", container)
