"""Standard output of the commands `python -m emberwatch...`."""

import signal


def end_with_reader() -> None:
    """Ends this process silently, as other programs end, if its reader leaves early (`| head`)."""
    if hasattr(signal, "SIGPIPE"):  # not on Windows
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
