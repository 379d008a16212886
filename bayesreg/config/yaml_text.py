"""Read YAML from untrusted sources: size, depth and number of entries are limited, and tags are refused."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError
from ruamel.yaml.events import CollectionEndEvent, CollectionStartEvent, NodeEvent, ScalarEvent
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from bayesreg.config.errors import ConfigError
from bayesreg.printable import find_unprintable

# A configuration with all defaults has about 150 lines and three levels below a list; a label table has up to 1,000
# entries.
MOST_CHARACTERS, MOST_ENTRIES, DEEPEST, LONGEST_PLAIN = 1_000_000, 20_000, 20, 4_000


def parse(text: str, name: str) -> tuple[Any, Node | None]:
    """Parse a YAML text into its content and its nodes; the nodes hold line numbers.

    Parameters
    ----------
    text : str
    name : str
        The name of the text in messages.

    Raises
    ------
    ConfigError
        If the text is not YAML, is too long or too deep, or has too many entries. The message names the line.
    """
    if len(text) > MOST_CHARACTERS:
        raise ConfigError(f"{name}: {len(text):,} characters are more than the {MOST_CHARACTERS:,} that are read")
    try:
        _require_bounds(text, name)
        node = YAML(typ="safe", pure=True).compose(text)
        _require_tree(node, name)
        return YAML(typ="safe", pure=True).load(text), node
    except MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise ConfigError(f"{name}{line}: not valid YAML: {error.problem}") from None
    except ConfigError:
        raise
    except Exception as error:
        # The YAML reader also raises the exceptions of its parts, such as ValueError for a date like 2026-13-01.
        first = (str(error).splitlines() or [type(error).__name__])[0]
        raise ConfigError(f"{name}: not valid YAML: {first:.200}") from None


def _require_bounds(text: str, name: str) -> None:
    """Raise ConfigError if the text exceeds the limits of the next steps."""
    depth = entries = 0
    for event in YAML(typ="safe", pure=True).parse(text):
        if not isinstance(event, NodeEvent | CollectionEndEvent):
            continue
        where = f"{name}, line {event.start_mark.line + 1}"
        depth += isinstance(event, CollectionStartEvent) - isinstance(event, CollectionEndEvent)
        entries += not isinstance(event, CollectionEndEvent)
        if depth > DEEPEST:
            raise ConfigError(f"{where}: more than {DEEPEST} levels, one in another")
        if entries > MOST_ENTRIES:
            raise ConfigError(f"{where}: more than {MOST_ENTRIES:,} entries")
        if isinstance(event, ScalarEvent) and len(event.value) > LONGEST_PLAIN and event.style is None:
            raise ConfigError(f"{where}: a value of {len(event.value):,} characters; put a text so long in quotes")
        if isinstance(event, ScalarEvent) and (odd := find_unprintable(event.value)):
            raise ConfigError(f"{where}: a character that cannot be printed, {odd}")
        tag = event.tag if isinstance(event, ScalarEvent | CollectionStartEvent) else None
        if tag is not None and str(tag) != "!":
            raise ConfigError(f"{where}: tags such as {tag} are not read; write the value alone")


def _require_tree(node: Node | None, name: str) -> None:
    """Raise ConfigError if anchors form a cycle, or aliases expand the text to too many entries."""
    count = 0
    # Each waiting node has the identities of its ancestors; a node among them forms a cycle.
    waiting: list[tuple[Node, frozenset[int]]] = [] if node is None else [(node, frozenset())]
    while waiting:
        current_node, above = waiting.pop()
        count += 1
        if id(current_node) in above:
            raise ConfigError(f"{name}, line {current_node.start_mark.line + 1}: an anchor that holds itself")
        if count > MOST_ENTRIES:
            raise ConfigError(f"{name}: aliases make more than {MOST_ENTRIES:,} entries")
        if isinstance(current_node, MappingNode) and (
            odd := [key for key, _ in current_node.value if not isinstance(key, ScalarNode)]
        ):
            raise ConfigError(f"{name}, line {odd[0].start_mark.line + 1}: a key that is no text")
        waiting += [(child, above | {id(current_node)}) for child in _children(current_node)]


def _children(node: Node) -> Iterator[Node]:
    if isinstance(node, MappingNode):
        for pair in node.value:
            yield from pair
    elif isinstance(node, SequenceNode):
        yield from node.value
