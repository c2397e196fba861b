"""Everything that commands print goes through here, and no text is markup: neither ours nor what comes from outside.

A path may hold square brackets, and a name may hold escape sequences: both are shown as they are, the latter escaped.
Whoever wants colours gives pieces of text with their style: `console.tell(("Error:", "bold red"), " ", what)`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.console import Console, RenderableType
from rich.panel import Panel
from rich.text import Text

from service.core.words import shown_continued, shown_lines

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn

Piece = str | tuple[str, str]  # text, or text with its style


class Terminal(Console):
    """A console that takes no text for markup and escapes what a terminal would obey.

    A text of several lines is continued with an indent, so that nothing from outside looks like a line of its own.
    """

    def __init__(self, **options: Any) -> None:
        given: dict[str, Any] = {"highlight": False, "soft_wrap": True, **options, "markup": False, "emoji": False}
        super().__init__(**given)

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a string as it is printed; Rich calls this for everything that is not a Text."""
        given: dict[str, Any] = {**options, "markup": False, "emoji": False}
        return super().render_str(shown_continued(text), **given)

    def tell(self, *pieces: Piece) -> None:
        """Print one line of pieces, each with its style."""
        self.print(styled(*pieces))

    def boxed(self, lines: str, title: str) -> None:
        """Print lines in a box, wrapped at the terminal's edge; a title that is too long for it stands above."""
        heading, fits = styled(title), len(title) < 60
        if not fits:
            self.print(heading, soft_wrap=False)
        box = Panel(Text(shown_lines(lines), overflow="fold"), title=heading if fits else None)
        self.print(box, soft_wrap=False)


def styled(*pieces: Piece) -> Text:
    """Return pieces of text with their styles as one line, for a cell of a table, say."""
    given = ((piece, "") if isinstance(piece, str) else piece for piece in pieces)
    return Text.assemble(*((shown_continued(text), style) for text, style in given))


def listed(*lines: RenderableType) -> Text:
    """Return lines within one cell of a table, without the empty ones."""
    made = (line if isinstance(line, Text) else styled(str(line)) for line in lines)
    return Text("\n").join([line for line in made if line.plain])


def bar_of_shares(to: Terminal) -> Progress:
    """Return a progress bar that shows the share that is done. Its words are not escaped: give them `shown`."""
    from rich.progress import TaskProgressColumn  # noqa: PLC0415 - most commands have no bar

    return _bar(to, "{task.description}", TaskProgressColumn())


def bar_of_counts(to: Terminal) -> Progress:
    """Return a progress bar that shows how many are done. Its words are not escaped: give them `shown`."""
    from rich.progress import MofNCompleteColumn  # noqa: PLC0415

    return _bar(to, "  {task.description}", MofNCompleteColumn())


def _bar(to: Terminal, words: str, done: ProgressColumn) -> Progress:
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn  # noqa: PLC0415

    text = TextColumn(words, markup=False)
    return Progress(text, BarColumn(), done, TimeRemainingColumn(), console=to, transient=True)
