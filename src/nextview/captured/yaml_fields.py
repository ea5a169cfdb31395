"""YAML as cameras and recorders write it: fields, lists, numbers and text, within bounds.

A few hundred bytes of YAML can name a list of lists of lists as often as they like, and a tag can
ask for a value that its text is not. Here a text is read event by event, its size is known before
it is built, and what is no number is text.
"""

from typing import Any

import yaml

from nextview.checks import one_line
from nextview.errors import DatasetError

MOST_YAML_VALUES = 100_000  # of a file, with all that its aliases repeat
DEEPEST_YAML = 50  # lists and fields inside each other
OPENCV_HEADER = (
    "%YAML:"  # which no YAML reader takes; the rest of OpenCV's files is YAML
)
# what a word stands for; all else is a number or text
YAML_WORDS = {
    "": None,
    "~": None,
    "null": None,
    "true": True,
    "false": False,
}


class _Unfinished:
    """A list or the fields of a mapping, as far as they were read.

    Attributes:
        values: those of a list; keys and values, one after the other, of a mapping.
        is_list: which of both it is.
        anchor: by which others repeat it, if it has one.
        count: values in it, with those that aliases repeat.
    """

    def __init__(self, is_list: bool, anchor: str | None) -> None:
        self.values: list[Any] = []
        self.is_list = is_list
        self.anchor = anchor
        self.count = 1

    def finished(self, where: str) -> Any:
        """The list, or a dictionary."""
        if self.is_list:
            return self.values
        keys = self.values[::2]
        if not all(isinstance(key, str | int | float | None) for key in keys):
            raise DatasetError(f"{where}: a name in it is no word")
        return dict(zip(keys, self.values[1::2], strict=True))


def read_yaml(text: str, where: str) -> Any:
    """The content of a YAML text; of its first document, where it has several.

    Args:
        text: as a file holds it.
        where: beginning of the sentence of an error.

    Returns:
        Dictionaries, lists, numbers (float), text, True, False and None.

    Raises:
        DatasetError: it is no YAML, or repeats itself beyond ``MOST_YAML_VALUES``.
    """
    if text.startswith(OPENCV_HEADER):
        text = text.partition("\n")[2]
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        return _built(yaml.parse(text, Loader=loader), where)
    except (yaml.YAMLError, RecursionError) as error:
        raise DatasetError(f"{where}: no YAML ({one_line(str(error), 120)})") from None


def _built(events: Any, where: str) -> Any:
    """The first document of a row of events."""
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
    """A number if the text of a plain value is one; whatever its tag asks for."""
    text = event.value
    if not event.implicit[0] and event.style is not None:
        return text  # in quotes
    if text.lower() in YAML_WORDS:
        return YAML_WORDS[text.lower()]
    try:
        return float(text)
    except ValueError:
        return text
