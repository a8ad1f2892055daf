"""The box's clock on the host's: the bounds hold, whatever the line does."""

from __future__ import annotations

import random

import pytest

from drivers.serial_projector.clock import MOST_DRIFT, DeviceClock

BEGUN_NS = 5_000_000_000


class Truth:
    """A box whose clock began at BEGUN_NS and is off by `drift`."""

    def __init__(self, drift: float) -> None:
        self.drift = drift

    def device_us(self, host_ns: float) -> int:
        return round((host_ns - BEGUN_NS) * (1 + self.drift) / 1000)

    def exchange(self, clock: DeviceClock, sent_ns: int, there_ns: int, back_ns: int) -> None:
        clock.note(self.device_us(sent_ns + there_ns), sent_ns, sent_ns + there_ns + back_ns)


@pytest.mark.parametrize("drift", [0.0, 30e-6, -30e-6, 0.9 * MOST_DRIFT, -0.9 * MOST_DRIFT])
@pytest.mark.parametrize("seed", range(4))
def test_the_error_that_is_stated_holds(drift: float, seed: int) -> None:
    rng, truth, clock = random.Random(seed), Truth(drift), DeviceClock()
    now_ns = BEGUN_NS + 10**9
    for _ in range(400):
        now_ns += round(rng.uniform(0.01e9, 0.6e9))
        there_ns, back_ns = (round(rng.expovariate(1 / 200_000)) + 20_000 for _ in range(2))
        truth.exchange(clock, now_ns, there_ns, back_ns)
        asked_ns = now_ns + round(rng.uniform(-0.5e9, 0.5e9))
        t_ns, error_ns = clock.host_ns(truth.device_us(asked_ns))
        # The box's own counter has steps of 1 µs.
        assert abs(t_ns - asked_ns) <= error_ns + 1_000


def test_drift_falls_out_with_time() -> None:
    truth, clock = Truth(200e-6), DeviceClock()
    errors_ns = []
    for step in range(240):
        now_ns = BEGUN_NS + step * 250_000_000
        truth.exchange(clock, now_ns, 100_000, 100_000)
        errors_ns.append(clock.host_ns(truth.device_us(now_ns + 200_000_000))[1])
    low, high = clock.rate
    assert low <= 1 / (1 + 200e-6) <= high
    assert high - low < 12e-6
    # At first, 0.2 s ahead may be off by 0.1 % of it; after a minute the exchange alone is left.
    assert errors_ns[0] > 250_000
    assert max(errors_ns[120:]) < 110_000


def test_the_shortest_exchange_counts() -> None:
    truth, clock = Truth(0.0), DeviceClock()
    for step, there_ns in enumerate((5_000_000, 50_000, 9_000_000, 2_000_000)):
        truth.exchange(clock, BEGUN_NS + step * 20_000_000, there_ns, there_ns)
    assert clock.host_ns(truth.device_us(BEGUN_NS + 60_000_000))[1] < 100_000


def test_a_retry_widens_and_does_not_mislead() -> None:
    truth, clock = Truth(0.0), DeviceClock()
    # Obeyed at once, answered 300 ms later: the answer was lost twice.
    truth.exchange(clock, BEGUN_NS, 50_000, 300_000_000)
    t_ns, error_ns = clock.host_ns(truth.device_us(BEGUN_NS + 50_000))
    assert abs(t_ns - BEGUN_NS - 50_000) <= error_ns <= 151_000_000


def test_a_clock_that_jumps_is_learnt_afresh() -> None:
    clock = DeviceClock()
    Truth(0.0).exchange(clock, BEGUN_NS, 50_000, 50_000)
    clock.note(7, BEGUN_NS + 10**9, BEGUN_NS + 10**9 + 100_000)
    t_ns, error_ns = clock.host_ns(7)
    assert abs(t_ns - BEGUN_NS - 10**9 - 50_000) <= error_ns <= 51_000


def test_nothing_is_known_before_the_first_exchange() -> None:
    with pytest.raises(ValueError, match="no exchange"):
        DeviceClock().host_ns(0)
