"""YAML that says everything once: of two equal keys the safe loader lets only the last count, and drops the first."""

from __future__ import annotations

import os
from functools import cache
from typing import Any

from grr_torch.errors import FileFormatError

_TEXT, _MERGE = "tag:yaml.org,2002:str", "tag:yaml.org,2002:merge"


def parse_yaml(text: str, source: str | os.PathLike[str]) -> Any:
    """The data in a text, by the safe loader. Keys are texts, each of them given once.

    Args:
        text: The text.
        source: What it is called in errors.

    Raises:
        FileFormatError: It is not YAML, a key is given twice or no text, or a value is none of its tag's.
    """
    import yaml

    try:
        return yaml.load(text, Loader=_loader())  # a safe loader
    except (yaml.YAMLError, ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise FileFormatError(source, f"is not YAML that can be used: {reason}") from error


@cache
def _loader() -> Any:
    import yaml

    class Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]  # yaml comes without types
        def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
            found = set()
            for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
                problem = None
                if key.tag not in (_TEXT, _MERGE):
                    problem = f"{key.value} is no name"
                elif key.value in found:
                    problem = f"'{key.value}' is given twice"
                if problem:
                    raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
                found.add(key.value)
            return dict(super().construct_mapping(node, deep))

    return Loader
