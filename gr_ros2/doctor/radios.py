"""Finds the radios that are plugged in or answer.

Invariant: no radio is opened or configured. The buses are listed, and the vendors' own programs are run.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from gr_ros2.core.errors import BackendMissingError
from gr_ros2.doctor.finding import Finding
from gr_ros2.doctor.programs import output_of
from gr_ros2.radio import FRONT_ENDS

USB = Path("/sys/bus/usb/devices")
KNOWN = {
    "0456:b673": "ADALM-Pluto",
    "2500:0020": "USRP B200/B210",
    "2500:0021": "USRP B200mini",
    "2500:0022": "USRP B205mini",
    "3923:7813": "USRP B200 (NI)",
    "3923:7814": "USRP B210 (NI)",
    "1d50:6089": "HackRF One",
    "1d50:604b": "HackRF Jawbreaker",
    "1d50:6108": "LimeSDR-USB",
    "0403:601f": "LimeSDR-Mini",
    "2cf0:5246": "bladeRF",
    "2cf0:5250": "bladeRF 2.0",
    "1d50:6066": "bladeRF",
    "1d50:60a1": "Airspy (receives only)",
    "0bda:2832": "RTL-SDR (receives only)",
    "0bda:2838": "RTL-SDR (receives only)",
}
"""USB vendor and product ids of radios, from their makers and the Linux USB list."""
PACKAGES = {"SoapySDRUtil": "soapysdr-tools", "uhd_find_devices": "uhd-host", "iio_info": "libiio-utils"}
"""Programs that find devices, and the Debian and Ubuntu package of each."""
_NOTHING = ("no devices found", "no uhd devices found", "no contexts found", "no iio context", "unable to")


def usb(devices: Path = USB, nodes: Path = Path("/dev/bus/usb")) -> Iterator[Finding]:
    """Radios on USB, and whether this user may open them.

    :param devices: folder in which the kernel lists the devices that are plugged in
    :param nodes: folder of their device files
    """
    found = False
    for device in sorted(devices.glob("*")):
        vendor, product, bus, number = (_read(device / name) for name in ("idVendor", "idProduct", "busnum", "devnum"))
        name = KNOWN.get(f"{vendor}:{product}")
        if name is None:
            continue
        found = True
        node = nodes / f"{int(bus or 0):03}" / f"{int(number or 0):03}"
        if os.access(node, os.R_OK | os.W_OK):
            yield Finding("USB", "ok", f"{name} ({vendor}:{product}) at {node}")
        else:
            remedy = "sudo usermod -aG plugdev $USER, log in again; the driver's package brings its udev rules"
            yield Finding("USB", "warning", f"{name} ({vendor}:{product}): {node} may not be written", remedy)
    if not found:
        yield Finding("USB", "note", "no radio that is known here is plugged in")


def programs() -> Iterator[Finding]:
    """What the vendors' programs find, for each front end that has a radio."""
    for name in FRONT_ENDS.own:
        try:
            front_end = FRONT_ENDS.load(name)
        except BackendMissingError:
            continue  # reported by the checks of what is installed
        if front_end.find_with:
            yield _asked(name, front_end.find_with)


def sound() -> Iterator[Finding]:
    """Sound devices, for the front end `audio`."""
    try:
        FRONT_ENDS.load("audio")
    except BackendMissingError:
        return  # reported by the checks of what is installed
    from gr_ros2.radio.audio_card import PortAudioError, devices

    try:
        found = devices()
    except PortAudioError as error:
        yield Finding("sound", "note", " ".join(str(error).split()))
        return
    both = [device for device in found if device["max_input_channels"] and device["max_output_channels"]]
    if not both:
        yield Finding("sound", "note", "no sound device that plays and records")
        return
    yield Finding("sound", "ok", f"devices that play and record: {', '.join(device['name'] for device in both)}")


def _asked(name: str, command: str) -> Finding:
    words = command.split()
    output = output_of(words)
    if output is None:
        remedy = f"sudo apt install {PACKAGES[words[0]]}" if words[0] in PACKAGES else f"install {words[0]}"
        return Finding(name, "note", f"cannot be looked for: {words[0]} is not installed", remedy)
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    if not lines or any(text in output.lower() for text in _NOTHING):
        return Finding(name, "note", f"`{command}` finds none")
    return Finding(name, "ok", f"`{command}`: {'; '.join(line for line in lines if '=' in line or ':' in line)[:300]}")


def _read(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""
