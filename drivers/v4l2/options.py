"""Options of the driver `v4l2`."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, field_validator, model_validator

from drivers.v4l2.formats import LAYOUTS
from slrig.bundle import Strict
from slrig.model import Size

Extent = Annotated[int, Field(ge=1, le=65_536)]


class V4L2Options(Strict, use_attribute_docstrings=True):
    """The keys of a `[[camera]]` table with `driver = "v4l2"` (in addition to name, exposure_s and gain)."""

    device: Annotated[str, Field(min_length=1)]
    """A name that `slrig devices` lists, or a path (`/dev/video0`, `/dev/v4l/by-path/…`)."""

    pixel_format: Annotated[str, Field(min_length=3, max_length=4)] | None = None
    """Four characters as `v4l2-ctl --list-formats` writes them; else the best that the device offers: linear before
    encoded, grey before colour, deep before shallow, of those that reach 15 frames per second."""

    size_px: Annotated[tuple[Extent, Extent], Field(strict=False)] | None = None
    """[width, height]; else the largest that reaches 15 frames per second (or frame_rate_hz), if any does."""

    frame_rate_hz: Annotated[float, Field(gt=0, le=100_000)] | None = None
    """Frames per second; else as the device is set, or the next that is 15 or more."""

    bit_depth: Annotated[int, Field(ge=8, le=16)] | None = None
    """Number of low bits of a 16-bit sample that the sensor fills (Y16 and 16-bit Bayer only); else all."""

    sample_shift: Annotated[int, Field(ge=0, le=8)] = 0
    """Bits by which samples are shifted up in their 16-bit words (10 to 14 bits), the bits below repeating the upper
    ones: 6 for 10 bits that fill the upper ones, as on Jetson Xavier and later; 0 on Jetson Nano."""

    limited_luma: bool = False
    """True if the camera sends luma as 16 to 235 (YUV formats): it is expanded to 0 to 255."""

    buffers: Annotated[int, Field(ge=2, le=32)] = 4
    """Frames that the kernel may hold; a frame waits there for at most this number of frame periods."""

    settle_frames: Annotated[int, Field(ge=1, le=1000)] = 5
    """Frames discarded after the stream starts, until the settings have taken effect."""

    gain_unity: Annotated[int, Field(ge=1)] | None = None
    """Value of the gain control at which the sensor's gain is 1, if gain is proportional to it."""

    focus: int | None = None
    """Value of the focus control; autofocus is off in any case."""

    controls: dict[str, int] = Field(default_factory=dict)
    """Further controls by their names in `v4l2-ctl --list-ctrls`; they override what the driver would set."""

    skip_controls: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Controls to leave as they are, by those names: some cameras answer some controls with faults."""

    readout_s: Annotated[float, Field(ge=0, le=60)] | None = None
    """Time from the end of the first row's exposure to the last row's arrival; else a frame period, the upper limit."""

    stamp_delay_s: Annotated[float, Field(ge=0, le=60)] = 0.0
    """Measured delay of the camera's time stamps."""

    @field_validator("pixel_format")
    @classmethod
    def _check_pixel_format(cls, text: str | None) -> str | None:
        if text is not None and text.ljust(4) not in LAYOUTS:
            known = ", ".join(sorted(code.strip() for code in LAYOUTS))
            message = f"expected a pixel format that can be read ({known}), found '{text}'; choose one of them"
            raise ValueError(message)
        return text

    @model_validator(mode="after")
    def _check_controls(self) -> Self:
        both = sorted(self.controls.keys() & set(self.skip_controls))
        if both:
            message = f"{', '.join(both)}: named in controls, to set, and in skip_controls, to leave alone; choose one"
            raise ValueError(message)
        return self

    @property
    def size(self) -> Size | None:
        """The requested size of frames, if any."""
        return None if self.size_px is None else Size(*self.size_px)
