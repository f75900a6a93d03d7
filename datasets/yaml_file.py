"""The one loader of YAML: bounded, plain data only, complaints with file, line, key and remedy.

Every file that a person or a run wrote in YAML is read here: calibration, configuration, places,
drives, structures, run folders. YAML has more than such files need, and some of it is dangerous:
merge keys and aliases that expand without end, nesting that exhausts the stack, tags that make
objects. So there are bounds, merge keys are refused, and keys and dates are text.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError
from yaml.constructor import SafeConstructor

from datasets.errors import InputError, reading

Keys = Sequence[str | int]
Model = TypeVar("Model", bound=BaseModel)

LONGEST_BYTES: Final = 1_000_000
MOST_NODES: Final = 200_000
"""Values in a file, counted as often as aliases repeat them."""
DEEPEST: Final = 40
"""Levels of mappings and sequences in each other."""
_LARGEST_INT: Final = 2**63

# libyaml's loader is ten times as fast; PyYAML's wheels have it, an own build may not.
_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_BOUNDS_REMEDY: Final = "Give a file that a person could have written."


@dataclass(frozen=True, slots=True)
class MarkedYaml:
    """A YAML text whose keys still know their lines.

    label   : the file, as errors name it.
    example : a sentence for remedies that shows one, or says where one is.
    content : plain data: mappings, sequences, text, numbers, true and false, None.
    """

    label: str
    example: str
    content: Any
    tree: yaml.Node | None

    @classmethod
    def read(cls, path: Path, kind: str, example: str, remedy: str) -> MarkedYaml:
        """Read a file. kind, remedy : for the error if it can't be read, as in "the calibration".

        Raises InputError as ``parse`` does, and if the file is not there, too long or no text.
        """
        with (
            reading(f"{kind} can't be read", where=str(path), remedy=remedy),
            path.open("rb") as file,
        ):
            text = file.read(LONGEST_BYTES + 1).decode("utf-8")
        return cls.parse(text, str(path), example)

    @classmethod
    def parse(cls, text: str, label: str, example: str) -> MarkedYaml:
        """Raises InputError that names the line if it is no YAML of plain data within the bounds.

        So it does if a key is said twice, and for merge keys (``<<``).
        """
        if len(text) > LONGEST_BYTES:
            raise InputError(
                f"longer than {LONGEST_BYTES} bytes", where=label, remedy=_BOUNDS_REMEDY
            )
        try:
            _check_depth(text, label)
            tree = yaml.compose(text, Loader=_Loader)
        except (yaml.YAMLError, ValueError) as error:  # ValueError: a lone surrogate
            mark, at = getattr(error, "problem_mark", None), getattr(error, "position", None)
            place = f", line {mark.line + 1}" if mark is not None else ""
            if at is not None:  # a character that YAML doesn't have
                line = text.encode(errors="replace").count(b"\n", 0, at) + 1
                place = f", line {line}"
            reason = getattr(error, "problem", None) or getattr(error, "reason", None) or error
            raise InputError(
                f"not readable as YAML ({reason})",
                where=f"{label}{place}",
                remedy="Check indentation, colons and brackets.",
            ) from error
        return cls(label, example, _Plain(label).data(tree), tree)

    def error(self, keys: Keys, what: str, remedy: str) -> InputError:
        """An error about what stands under some keys."""
        where = f"{self.label}, line {self._line(keys)}"
        if keys:
            where += f", key {'.'.join(map(str, keys))}"
        return InputError(what, where=where, remedy=remedy)

    def validate(self, schema: type[Model]) -> Model:
        """The content as a model. Raises InputError about the first thing that is wrong."""
        try:
            return schema.model_validate({} if self.content is None else self.content)
        except ValidationError as error:
            every = error.errors(include_url=False)
            # A key that is misspelt is missing as well: the misspelling tells more.
            first = next((e for e in every if e["type"] == "extra_forbidden"), every[0])
            keys = first["loc"]
            if first["type"] == "extra_forbidden":
                known = ", ".join(_owner(schema, keys[:-1]).model_fields)
                raise self.error(keys, "no such key", f"Known here are: {known}.") from error
            if first["type"] == "missing":
                raise self.error(keys, "this key is missing", f"Add it. {self.example}") from error
            what = first["msg"].removeprefix("Value error, ")
            if first["type"] in ("model_type", "dict_type"):
                what = "`key: value` is needed here"
            remedy = f"Correct it. {self.example}"
            raise self.error(keys, what[0].lower() + what[1:], remedy) from error

    def _line(self, keys: Keys) -> int:
        """The line, from 1, of the innermost key that is there."""
        node, line = self.tree, 1
        for key in keys:
            if isinstance(node, yaml.MappingNode):
                found = [(k, v) for k, v in node.value if k.value == str(key)]
                if not found:
                    break
                line, node = _line(found[0][0]), found[0][1]
            elif isinstance(node, yaml.SequenceNode) and isinstance(key, int):
                if key >= len(node.value):
                    break
                node = node.value[key]
                line = _line(node)
            else:
                break
        return line


def _check_depth(text: str, label: str) -> None:
    """Refuse nesting before anything that recurses sees it."""
    depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > DEEPEST:
                raise InputError(
                    f"more than {DEEPEST} levels in each other",
                    where=f"{label}, line {_line(event)}",
                    remedy=_BOUNDS_REMEDY,
                )
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1


def _line(marked: yaml.Node | yaml.Event) -> int:
    """Where it begins, from 1."""
    return 1 if marked.start_mark is None else marked.start_mark.line + 1


class _Plain:
    """Makes plain data of a tree of nodes; a node that is more than that raises InputError."""

    def __init__(self, label: str) -> None:
        self._label = label
        self._values = SafeConstructor()
        self._open: set[int] = set()
        self._count = 0

    def data(self, node: yaml.Node | None) -> Any:  # noqa: ANN401 - a file may hold anything
        if node is None:
            return None
        self._count += 1
        if self._count > MOST_NODES:
            raise self._error(node, f"more than {MOST_NODES} values", _BOUNDS_REMEDY)
        if isinstance(node, yaml.ScalarNode):
            return self._scalar(node)
        if id(node) in self._open:
            raise self._error(node, "it stands in itself by an alias", "Write it out.")
        self._open.add(id(node))
        kind = "map" if isinstance(node, yaml.MappingNode) else "seq"
        if node.tag != f"tag:yaml.org,2002:{kind}":
            raise self._error(node, f"the tag {node.tag} is not known here", "Leave it out.")
        found: Any
        if isinstance(node, yaml.MappingNode):
            found = self._mapping(node)
        else:
            found = [self.data(entry) for entry in node.value]
        self._open.discard(id(node))
        return found

    def _mapping(self, node: yaml.MappingNode) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise self._error(key, "a key must be a word", "Correct it.")
            if key.tag == "tag:yaml.org,2002:merge":
                raise self._error(key, "merge keys (<<) are not read", "Write the keys out.")
            if key.value in found:
                raise InputError(
                    "the key stands here a second time",
                    where=f"{self._label}, line {_line(key)}, key {key.value}",
                    remedy="Leave one of the two, or give them different names.",
                )
            found[key.value] = self.data(value)
        return found

    def _scalar(self, node: yaml.ScalarNode) -> object:
        kind = node.tag.removeprefix("tag:yaml.org,2002:")
        text: str = node.value
        if kind in ("str", "timestamp", "value", "merge"):
            return text
        if kind == "null":
            return None
        try:
            if kind == "bool":
                return self._values.construct_yaml_bool(node)
            if kind in ("int", "float") and len(text) <= 100:
                number: int | float = getattr(self._values, f"construct_yaml_{kind}")(node)
                said_infinite = text.lstrip("+-").lower() == ".inf"
                if math.isinf(number) and not said_infinite:
                    raise OverflowError
                if isinstance(number, float) or abs(number) < _LARGEST_INT:
                    return number
            if kind in ("int", "float"):
                raise OverflowError
        except OverflowError:
            raise self._error(node, f"the number {text} is too large", "Correct it.") from None
        except (ValueError, KeyError, IndexError):
            raise self._error(node, f"{text!r} is no {kind}", "Correct it.") from None
        raise self._error(node, f"the tag {node.tag} is not known here", "Leave it out.")

    def _error(self, node: yaml.Node, what: str, remedy: str) -> InputError:
        return InputError(what, where=f"{self._label}, line {_line(node)}", remedy=remedy)


def _owner(schema: type[BaseModel], keys: Keys) -> type[BaseModel]:
    """The model that stands under some keys of a schema."""
    for key in keys:
        if isinstance(key, str) and key in schema.model_fields:
            schema = next(_models(schema.model_fields[key].annotation), schema)
    return schema


def _models(annotation: object) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from _models(part)
