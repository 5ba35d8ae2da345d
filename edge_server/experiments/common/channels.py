"""Channels that commands take as an option: a preset, or somebody's own file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from channel_emu.model.settings import channel_from_mapping
from freshfield.scenario import ScenarioError
from freshfield.untrusted import UntrustedError, read_text, read_yaml


def read_channel(text: str) -> tuple[dict[str, Any], str]:
    """The section and the name of a channel.

    text: a preset's name; a scenario's file, of which the ``channel`` section is taken; or a file of that section
        alone. File names in it are relative to its folder.
    Raises ScenarioError for a file that cannot be read, or that is no channel.
    """
    path = Path(text)
    section: Any = {"preset": text}
    if path.suffix or path.is_file():
        try:
            found = read_yaml(read_text(path))
        except FileNotFoundError:
            raise ScenarioError(f"--channel {text}: there is no such file") from None
        except (OSError, UnicodeDecodeError, UntrustedError) as error:
            raise ScenarioError(f"--channel {text}: {error}") from None
        section = found["channel"] if isinstance(found, dict) and "channel" in found else found
        section = _absolute(section, path.parent.resolve())
    channel_from_mapping(section, f"--channel {text}")
    return dict(section), path.stem if path.suffix else text


def _absolute(value: Any, folder: Path) -> Any:
    """The section with the names of files below ``folder``, such as FILE in ``trace:FILE``, made absolute."""
    if isinstance(value, dict):
        return {key: _absolute(inner, folder) for key, inner in value.items()}
    if isinstance(value, list):
        return [_absolute(inner, folder) for inner in value]
    if isinstance(value, str):
        return ":".join(str(folder / part) if part and (folder / part).is_file() else part for part in value.split(":"))
    return value
