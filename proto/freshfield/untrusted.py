"""Reads files that an attacker may have written or named, with bounded expansion of YAML and JSON.

A few hundred bytes of YAML or pickle can refer to themselves so often that they expand to gigabytes.
Expansion is therefore bounded by the file's size: an honest file has fewer values than bytes, even with
references. A repeated key in a mapping is refused, because either value may have been meant.
"""

from __future__ import annotations

import errno
import json
import re
import stat
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import yaml

from freshfield.limits import MAX_FILE_BYTES, MAX_YAML_CHARS, MAX_YAML_DEPTH, MIN_YAML_VALUES


class UntrustedError(ValueError):
    """A file that must not be read; the message says why."""


class _Loader(yaml.SafeLoader):
    def fetch_more_tokens(self) -> Any:
        if self.flow_level + len(self.indents) > MAX_YAML_DEPTH:
            raise UntrustedError("not YAML: nested too deeply")
        return super().fetch_more_tokens()

    def compose_mapping_node(self, anchor: Any) -> Any:
        node = super().compose_mapping_node(anchor)
        seen: set[Any] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):  # others are refused later: no mapping can have them as keys
                # As the constructor reads them: 1 and 01 are one key.
                name = key.value if key.tag == "tag:yaml.org,2002:merge" else self.construct_object(key)
                if name in seen:
                    raise UntrustedError(f"line {key.start_mark.line + 1}: {_repeated(str(name))}")
                seen.add(name)
        return node

    def construct_whole_number(self, node: Any) -> int:
        text = self.construct_scalar(node)
        value = int(text, {"0x": 16, "0o": 8}.get(text[:2], 10))
        str(value)  # ValueError for thousands of digits in hexadecimal: no message could quote them
        return value


class YamlWriter(yaml.SafeDumper):
    """For ``yaml.dump``: quotes text that ``read_yaml`` or a reader of YAML 1.1 would take for a number."""


# Numbers nearly as YAML 1.2 writes them: in 1.1, which PyYAML reads, 1:30 is 90, 010 is 8, and 1e-3 is text.
# What is rather a name or a serial number stays text: 08, 048322070531, 19443010E1234567.
_INT, _FLOAT = "tag:yaml.org,2002:int", "tag:yaml.org,2002:float"
_NUMBERS = {
    _INT: r"([-+]?(0|[1-9][0-9]*(_[0-9]+)*)|0x[0-9a-fA-F]+|0o[0-7]+)$",
    _FLOAT: r"[-+]?((\.[0-9]+|(0|[1-9][0-9]*)(\.[0-9]*)?)([eE][-+]?[0-9]{1,3})?|\.(inf|Inf|INF))$|"
    r"\.(nan|NaN|NAN)$",
}
_Loader.yaml_implicit_resolvers = {
    first: [(tag, form) for tag, form in known if tag not in _NUMBERS]
    for first, known in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
for _tag, _form in _NUMBERS.items():
    for _kind in (_Loader, YamlWriter):
        _kind.add_implicit_resolver(_tag, re.compile(_form), list("-+.0123456789"))
_Loader.add_constructor(_INT, _Loader.construct_whole_number)


def _repeated(key: str) -> str:
    return f"the key {key[:200]!r} is there twice: keep one"


def refuse_expansion(value: Any, most: int, parts: Callable[[Any], Iterable[Any]]) -> None:
    """Raise UntrustedError if ``value``, with every reference expanded, has more than ``most`` values.

    parts: returns the direct children of a value.
    """
    waiting, seen = [value], 0
    while waiting:
        seen += 1
        waiting.extend(parts(waiting.pop()))
        if seen + len(waiting) > most:
            raise UntrustedError(f"its references expand to more than {most} values")


def check_file(path: Path, most_bytes: int = MAX_FILE_BYTES) -> None:
    """Refuse what cannot be read to its end: a pipe blocks silently, and a device never ends. Raises OSError if the
    file does not exist, is not a regular one, or is larger than ``most_bytes``."""
    about = path.stat()
    if not stat.S_ISREG(about.st_mode):
        raise OSError(errno.EINVAL, "a folder, a device or a pipe, not a file")
    if about.st_size > most_bytes:
        raise OSError(errno.EFBIG, f"larger than {most_bytes >> 20} MB")


def read_bytes(path: Path, most_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Contents of a file that somebody has named. Raises OSError, also as ``check_file``."""
    check_file(path, most_bytes)
    with path.open("rb") as file:
        return file.read(most_bytes)


def read_text(path: Path) -> str:
    """Text of a file in UTF-8, with or without a byte order mark, that somebody has named. Raises OSError as
    ``read_bytes``, and UnicodeDecodeError."""
    return read_bytes(path).decode("utf-8-sig").replace("\r\n", "\n")


def stored_bytes(path: Path) -> int:
    """Size of a file, 0 if there is none: a bound on what an uncompressed archive, as ours are, can hold."""
    return path.stat().st_size if path.is_file() else 0


def read_yaml(text: str) -> Any:
    """The value of a YAML document, of plain types only; references are allowed.

    Raises UntrustedError if it is too long, not YAML, nested too deeply, repeats a key, or expands too far.
    """
    if len(text) > MAX_YAML_CHARS:
        raise UntrustedError(f"not YAML: {len(text)} characters, more than {MAX_YAML_CHARS}")
    loader = None
    try:
        loader = _Loader(text)  # refuses some characters at once
        node = loader.get_single_node()
        if node is None:
            return None
        refuse_expansion(node, max(MIN_YAML_VALUES, 20 * len(text)), _node_parts)
        return loader.construct_document(node)
    except UntrustedError:
        raise
    # A tag that claims a number, a date or a truth value for other text raises nearly anything.
    except (yaml.YAMLError, ValueError, LookupError, AttributeError, ArithmeticError) as error:
        raise UntrustedError(f"not YAML: {' '.join(str(error).split())}") from None
    finally:
        if loader is not None:
            loader.dispose()


def read_json(text: str) -> Any:
    """The value of a JSON document. Raises UntrustedError if it is invalid or repeats a key."""
    try:
        found = json.loads(text, object_pairs_hook=_object)
        if "\\u" in text:  # only an escape can stand for half a character
            _refuse_half_a_character(json.dumps(found, ensure_ascii=False))
        return found
    except UntrustedError:
        raise
    except RecursionError:
        raise UntrustedError("nested too deeply") from None
    except ValueError as error:
        raise UntrustedError(str(error)) from None


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise UntrustedError(_repeated(Counter(key for key, _ in pairs).most_common(1)[0][0]))
    return found


def _refuse_half_a_character(text: str) -> None:
    try:
        text.encode()
    except UnicodeEncodeError as error:
        half = text[error.start]
        raise UntrustedError(f"{half!r} is half of a character: no file can hold it") from None


def _node_parts(node: Any) -> Iterable[Any]:
    if isinstance(node, yaml.ScalarNode):
        _refuse_half_a_character(node.value)
    if isinstance(node, yaml.MappingNode):
        return (part for pair in node.value for part in pair)
    return node.value if isinstance(node, yaml.SequenceNode) else ()
