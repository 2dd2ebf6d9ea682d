"""Figures in files, drawn alike on every machine; what cannot be drawn does not end a command."""

import contextlib
import io
import os
from collections.abc import Callable, Sequence
from pathlib import Path

# Files need no backend and no settings of the user's, and wrong ones would end the import: a
# notebook hands its backend over to programs that lack it.
os.environ.pop("MPLBACKEND", None)
os.environ["MATPLOTLIBRC"] = os.devnull

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cmedirl_jax.runs.storage import outputs

# Matplotlib's classes are imported from here, so that the environment is right before.
__all__ = ["Axes", "Figure", "save"]


def save(figure: Callable[[], Figure], files: Sequence[Path], say: Callable[[str], None]) -> bool:
    """Draw a figure and write its files; the same figure gives the same bytes.

    Args:
        figure: draws it. The user's settings of matplotlib do not reach it.
        files: their names say the format: PNG or SVG.
        say: called with a line if it cannot be drawn or written.

    Returns:
        Whether the files are written.
    """
    try:
        with matplotlib.rc_context():
            # The files hold no random ids, no date and no version.
            matplotlib.rcParams.update(matplotlib.rcParamsDefault)
            matplotlib.rcParams["svg.hashsalt"] = files[0].stem
            drawn = figure()
            for path in files:
                kind, buffer = path.suffix[1:], io.BytesIO()
                metadata = {"Date": None} if kind == "svg" else {"Software": None}
                drawn.savefig(buffer, format=kind, dpi=150, metadata=metadata)
                # Laying out takes half of the time; every format has the first one's layout.
                drawn.set_layout_engine("none")
                outputs.write(path, buffer.getvalue())
    except Exception as error:
        # Drawing depends on this machine's fonts; what was measured stands without a figure, and an
        # earlier one would show other numbers.
        for path in files:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        say(f"{files[0].name} is not drawn ({reason})")
        return False
    return True
