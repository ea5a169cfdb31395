"""What newcomers call commands."""

from difflib import get_close_matches

from nextview.cli.commands import Program


def suggested_commands(program: Program, word: str) -> str:
    """Return the commands that a word may stand for, as the next part of a sentence.

    >>> from nextview.cli.commands import NEXTVIEW
    >>> suggested_commands(NEXTVIEW, "localise")
    "; did you mean 'look' (name and locate all known things on a table)?"

    Args:
        program: the program.
        word: that is no command; it may be misspelt.
    """
    meant: dict[str, list[str]] = {}
    for command, words in program.other_words.items():
        for other in words.split():
            meant.setdefault(other, []).append(command)
    known = {
        name for command in program.commands for name in (command, command.split()[0])
    }

    near = get_close_matches(word.lower(), [*sorted(known), *meant], 1, 0.6)
    if not near:
        return ""
    if near[0] in known and near[0] != word:
        return f"; did you mean {near[0]!r}?"
    commands = [
        f"{name!r} ({program.commands[name].line})" for name in meant.get(near[0], [])
    ]
    return f"; did you mean {' or '.join(commands)}?" if commands else ""
