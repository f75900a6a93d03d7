"""YAML that is checked by pydantic and complains with file, line, key and remedy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError

from datasets.errors import InputError

Keys = Sequence[str | int]
Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True, slots=True)
class MarkedYaml:
    """A YAML text whose keys still know their lines.

    label   : the file, as errors name it.
    example : a sentence for remedies that shows one, or says where one is.
    """

    label: str
    example: str
    content: Any
    tree: yaml.Node | None

    @classmethod
    def parse(cls, text: str, label: str, example: str) -> MarkedYaml:
        """Raises InputError that names the line if it is no YAML or says a key twice."""
        try:
            tree = yaml.compose(text, Loader=yaml.SafeLoader)
            content = yaml.safe_load(text)
        except (yaml.YAMLError, ValueError, RecursionError) as error:
            mark = getattr(error, "problem_mark", None)
            place = f", line {mark.line + 1}" if mark is not None else ""
            raise InputError(
                f"not readable as YAML ({getattr(error, 'problem', None) or error})",
                where=f"{label}{place}",
                remedy="Check indentation, colons and brackets.",
            ) from error
        marked = cls(label, example, content, tree)
        for node in _repeated_keys(tree):
            raise InputError(
                "the key stands here a second time",
                where=f"{label}, line {node.start_mark.line + 1}, key {node.value}",
                remedy="Leave one of the two, or give them different names.",
            )
        return marked

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
                line, node = found[0][0].start_mark.line + 1, found[0][1]
            elif isinstance(node, yaml.SequenceNode) and isinstance(key, int):
                if key >= len(node.value):
                    break
                node = node.value[key]
                line = node.start_mark.line + 1
            else:
                break
        return line


def _repeated_keys(tree: yaml.Node | None) -> Iterator[yaml.Node]:
    # An anchor may stand in many places, even in itself: each node is looked at once.
    waiting, seen = [tree], set()
    while waiting:
        node = waiting.pop()
        if node is None or id(node) in seen:
            continue
        seen.add(id(node))
        if isinstance(node, yaml.MappingNode):
            names = set()
            for key, value in node.value:
                if isinstance(key, yaml.ScalarNode) and key.value in names:
                    yield key
                names.add(key.value if isinstance(key, yaml.ScalarNode) else id(key))
                waiting.append(value)
        elif isinstance(node, yaml.SequenceNode):
            waiting.extend(node.value)


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
