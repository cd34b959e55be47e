"""Every error gr-ros2 raises, in one tree.

    GrRos2Error
    ├── ConfigError (ValueError)        a setting, file or argument is wrong: exit status 2
    │   └── RegistryError               the same, with file and line of a registry CSV
    ├── WireError (ValueError)          bytes that are not a valid packet, or a packet that cannot be encoded
    │   ├── LengthError · CrcError · VersionError · NoEntriesError
    │   ├── EntryBoundsError · PadError · TotalError · IndexRangeError
    │   ├── EntryKindError · VarintError · WindowError · SourcesError
    │   ├── SealError
    │   │   └── NoKeyError · NotSealedError · WrongKeyError · TagError · ReplayedError
    │   │       NotStoredError · SameIdError
    │   └── EncodeError
    ├── CodecError (ValueError)         a coded message that cannot be decoded here; ``fate`` names why
    │   └── UnknownDictionaryError · DamagedError · MissingFrameError · UnfitError
    │           └── OtherKindError
    ├── MiddlewareError (RuntimeError)  the ROS side failed
    │   ├── BagError                    a bag cannot be read or written
    │   └── DescriptionError            a node's description of a type cannot be used
    ├── PhyError (RuntimeError)         the flowgraph or radio failed
    │   └── RadioError                  a device or recording cannot be opened, set up or used
    ├── BackendMissingError (ImportError)  a back-end's package is not installed; names it
    └── RunError (RuntimeError)         an experiment could not be completed: exit status 1

Invariant: a message names the object, its value and the remedy, in one line. A long value is shown without its middle.
"""

from __future__ import annotations

from pathlib import Path

_BEGIN, _END = 300, 900
"""Characters of a long message that are shown: it begins with the object and its value, and ends with the remedy."""


def shortened(message: str) -> str:
    """A message in one line. At most 1,203 characters are shown; ``...`` stands for those in the middle. What cannot be
    printed is escaped."""
    if not message.isprintable():
        message = "".join(char if char.isprintable() else repr(char)[1:-1] for char in " ".join(message.split()))
    return message if len(message) <= _BEGIN + _END else f"{message[:_BEGIN]}...{message[-_END:]}"


def reason(error: Exception) -> str:
    """What the system or a library says, in one line, without the number and the file of an OSError: a message names
    the file itself."""
    told = error.strerror if isinstance(error, OSError) else None
    return told or " ".join(str(error).split()) or type(error).__name__


class GrRos2Error(Exception):
    """Root of the tree: catch this to catch everything gr-ros2 raises on purpose."""

    def __str__(self) -> str:
        return shortened(super().__str__())


class ConfigError(GrRos2Error, ValueError):
    """A setting, file or argument is wrong."""


class RegistryError(ConfigError):
    """A registry CSV is wrong.

    :param path: the file, or None where the registry was built in code
    :param line: line number from 1, or None for the file as a whole
    """

    def __init__(self, problem: str, path: str | Path | None = None, line: int | None = None) -> None:
        where = "registry" if path is None else str(path)
        if line is not None:
            where += f":{line}"
        super().__init__(f"{where}: {problem}")
        self.path = path
        self.line = line


class WireError(GrRos2Error, ValueError):
    """Bytes that are not a valid packet. ``kind`` is the name of its counter."""

    kind = "wire"

    def __init_subclass__(cls, kind: str) -> None:
        cls.kind = kind

    def alone(self) -> WireError:
        """The error without where it was raised: that would keep what was in the packet, in a cycle of references that
        a large process collects seldom."""
        self.__traceback__ = self.__context__ = self.__cause__ = None
        return self


class LengthError(WireError, kind="length"):
    """More or fewer bytes than ``packet_len`` allows."""


class CrcError(WireError, kind="crc"):
    """The CRC does not match."""


class VersionError(WireError, kind="version"):
    """A version nibble that this decoder does not know."""


class NoEntriesError(WireError, kind="no_entries"):
    """E = 0."""


class EntryBoundsError(WireError, kind="entry_bounds"):
    """An entry header or payload runs past the space before the CRC."""


class PadError(WireError, kind="pad"):
    """PAD bytes that are not zero."""


class TotalError(WireError, kind="total"):
    """An entry that says its message has no fragments (total = 0)."""


class IndexRangeError(WireError, kind="index"):
    """An entry whose index is not below its total."""


class EntryKindError(WireError, kind="entry_kind"):
    """An entry of an unknown kind, or whose fields contradict its kind."""


class VarintError(WireError, kind="varint"):
    """A number of variable length that is too long, too large, or not in its shortest form."""


class WindowError(WireError, kind="window"):
    """A repair whose window, mask and repair id contradict each other."""


class SealError(WireError, kind="seal"):
    """A packet that may be intact, but that cannot be trusted here."""


class NoKeyError(SealError, kind="no_key"):
    """A sealed packet where no key is configured."""


class NotSealedError(SealError, kind="not_sealed"):
    """A packet without a tag where a key is configured."""


class WrongKeyError(SealError, kind="wrong_key"):
    """A hello that none of the accepted keys opens, or that is damaged."""


class TagError(SealError, kind="tag"):
    """A tag that does not match: damaged, forged, or of another start of the sender."""


class ReplayedError(SealError, kind="replayed"):
    """A packet that was received before, or that is too old to be accepted."""


class NotStoredError(SealError, kind="not_stored"):
    """A packet that is not used because the state file cannot be written: it could be used again after a restart."""


class SameIdError(SealError, kind="same_id"):
    """A hello under the id of this robot, of a start that is not this one."""


class SourcesError(WireError, kind="max_sources"):
    """A packet of a further robot, when ``max_sources`` robots are known already."""


class EncodeError(WireError, kind="encode"):
    """A packet whose fields or size cannot be put on the wire."""


class CodecError(GrRos2Error, ValueError):
    """A coded message that cannot be decoded here. ``fate`` is what the ledger says of it."""

    fate = "unsupported"


class UnknownDictionaryError(CodecError):
    """A message coded with a dictionary that is not available here, or with a different one of the same name."""

    fate = "unknown_dictionary"


class DamagedError(CodecError):
    """Bytes that are not a coded message, or a message larger than the limit."""

    fate = "damaged"


class MissingFrameError(CodecError):
    """A frame whose predecessor was not decoded here: nothing is shown until the next key frame."""

    fate = "damaged"


class UnfitError(CodecError):
    """A message that a codec of its type does not code, such as an image in an unknown encoding. It passes exactly."""


class OtherKindError(UnfitError):
    """The same, of a message that may be another codec's, such as depth for that of pictures."""


class MiddlewareError(GrRos2Error, RuntimeError):
    """The ROS side failed."""


class DescriptionError(MiddlewareError):
    """What a node says about a type cannot be used."""


class BagError(MiddlewareError):
    """A bag cannot be read or written."""


class PhyError(GrRos2Error, RuntimeError):
    """The flowgraph, channel or radio failed."""


class RadioError(PhyError):
    """A front end's device, socket or recording cannot be opened, set up or used; the message names it."""


class BackendMissingError(GrRos2Error, ImportError):
    """A back-end was chosen whose package is not installed or is broken; the message names the package."""


class RunError(GrRos2Error, RuntimeError):
    """An experiment could not be completed."""
