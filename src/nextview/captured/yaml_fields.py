"""Read YAML files of cameras and recorders safely: mappings, lists, numbers and text.

A few hundred bytes of YAML can expand to huge nested lists through aliases, and a tag can request a
type that its text is not. This reader processes events, knows the expanded size before building the
values, and reads everything that is not a number as text.
"""

from typing import Any

import yaml

from nextview.checks import one_line
from nextview.errors import DatasetError

MOST_YAML_VALUES = 100_000  # in a file, including values repeated by aliases
DEEPEST_YAML = 50  # nesting of lists and mappings
OPENCV_HEADER = "%YAML:"  # not valid YAML; the rest of an OpenCV file is
# values of special words; everything else is a number or text
YAML_WORDS = {
    "": None,
    "~": None,
    "null": None,
    "true": True,
    "false": False,
}


class _Unfinished:
    """A list or a mapping that is being read.

    Attributes:
        values: elements of a list; alternating keys and values of a mapping.
        is_list: whether it is a list.
        anchor: name used by aliases, if it has one.
        count: number of values in it, including those repeated by aliases.
    """

    def __init__(self, is_list: bool, anchor: str | None) -> None:
        self.values: list[Any] = []
        self.is_list = is_list
        self.anchor = anchor
        self.count = 1

    def finished(self, where: str) -> Any:
        """Return the list, or a dictionary."""
        if self.is_list:
            return self.values
        keys = self.values[::2]
        if not all(isinstance(key, str | int | float | None) for key in keys):
            raise DatasetError(f"{where}: a name in it is no word")
        return dict(zip(keys, self.values[1::2], strict=True))


def read_yaml(text: str, where: str) -> Any:
    """Read a YAML text, or its first document if there are several.

    Args:
        text: content of a file.
        where: beginning of the error message.

    Returns:
        Dictionaries, lists, numbers (float), text, True, False and None.

    Raises:
        DatasetError: it is not YAML, or expands beyond ``MOST_YAML_VALUES``.
    """
    if text.startswith(OPENCV_HEADER):
        text = text.partition("\n")[2]
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        return _built(yaml.parse(text, Loader=loader), where)
    except (yaml.YAMLError, RecursionError) as error:
        raise DatasetError(f"{where}: no YAML ({one_line(str(error), 120)})") from None


def _built(events: Any, where: str) -> Any:
    """Build the first document of a sequence of events."""
    named: dict[str, tuple[Any, int]] = {}
    around = [_Unfinished(True, None)]

    def take(value: Any, count: int, anchor: str | None) -> None:
        if anchor is not None:
            named[anchor] = value, count
        around[-1].values.append(value)
        around[-1].count += count
        if around[-1].count > MOST_YAML_VALUES:
            raise DatasetError(
                f"{where}: holds more than {MOST_YAML_VALUES} values, with all that it repeats"
            )

    for event in events:
        if isinstance(event, yaml.ScalarEvent):
            take(_scalar(event), 1, event.anchor)
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor not in named:
                raise DatasetError(
                    f"{where}: *{event.anchor} repeats what is not complete there"
                )
            take(*named[event.anchor], None)
        elif isinstance(event, yaml.CollectionStartEvent):
            if len(around) > DEEPEST_YAML:
                raise DatasetError(
                    f"{where}: holds more than {DEEPEST_YAML} lists inside each other"
                )
            is_list = isinstance(event, yaml.SequenceStartEvent)
            around.append(_Unfinished(is_list, event.anchor))
        elif isinstance(event, yaml.CollectionEndEvent):
            done = around.pop()
            take(done.finished(where), done.count, done.anchor)
        elif isinstance(event, yaml.DocumentEndEvent):
            break
    return next(iter(around[0].values), None)


def _scalar(event: Any) -> Any:
    """Return a plain scalar as a number if its text is one, whatever its tag."""
    text = event.value
    if not event.implicit[0] and event.style is not None:
        return text  # quoted
    if text.lower() in YAML_WORDS:
        return YAML_WORDS[text.lower()]
    try:
        return float(text)
    except ValueError:
        return text
