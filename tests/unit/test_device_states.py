"""What drivers refuse by `CameraState` and `ProjectorState`, and in which words."""

from __future__ import annotations

import pytest

from slrig.devices import CameraInfo, CameraSettings, CameraState, ProjectorState, Trigger
from slrig.errors import DeviceStateError, UnsupportedByDeviceError
from slrig.model import Black, CameraFormat, Size, White
from slrig.patterns.sequence import encode

SIZE = Size(64, 48)
INFO = CameraInfo("left", "m", "s", CameraFormat(SIZE, 8), frozenset({Trigger.FREE}), (1e-3, 0.1), (1.0, 1.0))
USUAL = CameraSettings(0.01)


def armed(trigger: Trigger) -> CameraState:
    state = CameraState("left")
    state.armed = trigger
    return state


def test_camera_is_set_while_it_is_not_armed_and_read_while_it_is() -> None:
    state = CameraState("left")
    state.check_settings(USUAL, INFO)
    state.check_settings(CameraSettings(0.1005), INFO, within=0.01)
    state.check_arming(1, Trigger.FREE, INFO)
    with pytest.raises(DeviceStateError, match="camera 'left' is not armed for software triggers; call arm first"):
        state.require_armed(Trigger.SOFTWARE)
    with pytest.raises(DeviceStateError, match="not armed; call arm"):
        state.require_armed()
    for count, trigger in ((0, Trigger.FREE), (1, Trigger.SOFTWARE)):
        words = rf"{count} frames by {trigger} trigger.*by: free; use a wire"
        with pytest.raises(UnsupportedByDeviceError, match=words):
            state.check_arming(count, trigger, INFO, hint="; use a wire")
    state = armed(Trigger.FREE)
    state.require_armed()
    with pytest.raises(DeviceStateError, match="is armed; disarm it before changing"):
        state.check_settings(USUAL, INFO)
    with pytest.raises(DeviceStateError, match="armed already; disarm it first"):
        state.check_arming(1, Trigger.FREE, INFO)
    with pytest.raises(DeviceStateError, match="runs free; read a frame, or arm it for software triggers"):
        state.require_armed(Trigger.SOFTWARE)
    with pytest.raises(DeviceStateError, match="is armed for hardware triggers; read a frame"):
        armed(Trigger.HARDWARE).require_armed(Trigger.SOFTWARE)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (CameraSettings(0.2), r"exposure_s 0\.2, it takes 0\.001 to 0\.1; choose such a value"),
        (CameraSettings(float("nan")), "exposure_s nan"),
        (CameraSettings(0.01, 2.0), "gain 2, it takes 1 only"),
    ],
)
def test_settings_out_of_range_are_refused_with_the_range(settings: CameraSettings, words: str) -> None:
    with pytest.raises(UnsupportedByDeviceError, match=words):
        CameraState("left").check_settings(settings, INFO)


def test_a_closed_camera_refuses_everything() -> None:
    state = armed(Trigger.FREE)
    assert state.close()
    assert not state.close()
    assert state.armed is None
    for call in (
        state.require_open,
        state.require_armed,
        lambda: state.check_settings(USUAL, INFO),
        lambda: state.check_arming(1, Trigger.FREE, INFO),
    ):
        with pytest.raises(DeviceStateError, match="closed; open the rig again"):
            call()


def test_a_projector_shows_what_is_loaded() -> None:
    state, sequence = ProjectorState("the lamp"), encode((White(), Black()), SIZE)
    state.require_size(sequence, SIZE)
    with pytest.raises(UnsupportedByDeviceError, match="the lamp shows 64 x 40, the sequence was made for 64 x 48"):
        state.require_size(sequence, Size(64, 40))
    with pytest.raises(DeviceStateError, match="show pattern 0: no sequence is loaded"):
        state.require_pattern(0)
    state.loaded = sequence
    assert state.require_pattern(1) is sequence
    for index in (-1, 2):
        with pytest.raises(UnsupportedByDeviceError, match="patterns 0 to 1"):
            state.require_pattern(index)
    with pytest.raises(UnsupportedByDeviceError, match="the lamp has no trigger wire"):
        state.refuse_to_play(0.01, 0.02)
    state.closed.set()
    with pytest.raises(DeviceStateError, match="the lamp is closed"):
        state.require_pattern(0)
    with pytest.raises(DeviceStateError, match="the lamp is closed"):
        state.refuse_to_play(0.01, 0.02)
