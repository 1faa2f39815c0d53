"""The error of everything here."""


class FirmwareError(ValueError):
    """Firmware that cannot be built, configured or flown; the message is one sentence that names what."""
