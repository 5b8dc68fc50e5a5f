"""Docstrings and classes of rewax as Griffe, which reads them for the API pages, understands them.

``Gradient:`` and ``Source:`` become paragraphs with a bold beginning, ``Example:`` a section of examples.
``rewax.struct.dataclass`` makes constructors with keyword arguments.
"""

import re
from typing import Any

import griffe

_KEYWORD_ONLY = griffe.ParameterKind.keyword_only
_LABEL = re.compile(r"^(Gradient|Source):\s+(.*(?:\n[ \t]+\S.*)*)", flags=re.MULTILINE)


def readable(docstring: str) -> str:
    """The docstring with the sections that Griffe does not know as paragraphs."""
    text = _LABEL.sub(lambda match: f"\n**{match[1]}.** {' '.join(match[2].split())}\n", docstring)
    return re.sub(r"^Example:$", "Examples:", text, flags=re.MULTILINE)


class Docstrings(griffe.Extension):
    """The changes above, applied to everything that is read."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring:
            obj.docstring.value = readable(obj.docstring.value)

    def on_class_members(self, *, cls: griffe.Class, **_: Any) -> None:
        if any(str(decorator.value).startswith("struct.dataclass") for decorator in cls.decorators):
            cls.labels.add("dataclass")
            if "__init__" not in cls.members:
                cls.set_member("__init__", _constructor(cls))


def _constructor(cls: griffe.Class) -> griffe.Function:
    fields = [
        griffe.Parameter(name, annotation=member.annotation, kind=_KEYWORD_ONLY, default=_default(member))
        for name, member in cls.members.items()
        if isinstance(member, griffe.Attribute) and member.annotation is not None and "property" not in member.labels
    ]
    fields.sort(key=lambda parameter: parameter.default is not None)
    me = griffe.Parameter("self", kind=griffe.ParameterKind.positional_or_keyword)
    return griffe.Function("__init__", parameters=griffe.Parameters(me, *fields), parent=cls)


def _default(field: griffe.Attribute) -> Any:
    """What a field is if it is not given; None if it must be."""
    if not isinstance(field.value, griffe.ExprCall):
        return field.value
    given = {a.name: a.value for a in field.value.arguments if isinstance(a, griffe.ExprKeyword)}
    return given.get("default", "..." if "default_factory" in given else None)
