"""/metrics: the service's figures, for Prometheus. Needs the key, as the rest does. Touches no device."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from datetime import datetime

from fastapi import APIRouter, Response
from prometheus_client import CollectorRegistry
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4, generate_latest
from prometheus_client.registry import Collector

from slrig.api.service import Service, Serving
from slrig.calibration.health.verdict import HealthState
from slrig.jobs.records import JobState, utc_now
from slrig.schedule.records import RunState, TaskKind

router = APIRouter(tags=["system"])


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}, "description": "the figures"}},
)
def read_metrics(service: Serving) -> Response:
    """Return the service's figures in the text format of Prometheus: scans and scheduled runs by state, whether the rig
    is held, the calibration's age and expected error, the rig's health, and when each schedule is due next.
    """
    registry = CollectorRegistry()
    registry.register(_Figures(service))
    return Response(generate_latest(registry), media_type=CONTENT_TYPE_PLAIN_0_0_4)


class _Figures(Collector):
    """What a service says of itself now. Nothing is counted beside the records."""

    def __init__(self, service: Service) -> None:
        self._service = service

    def collect(self) -> Iterator[Metric]:
        """See `prometheus_client.registry.Collector`."""
        yield from self._rig()
        yield from self._calibration()
        yield from self._schedule()

    def _rig(self) -> Iterator[Metric]:
        states = Counter(self._service.store.states().values())
        scans = GaugeMetricFamily("slrig_scans", "Scans on record, by state.", labels=["state"])
        for state in JobState:
            scans.add_metric([state], states[state])
        yield scans
        status = self._service.runner.status()
        yield GaugeMetricFamily(
            "slrig_rig_open",
            "1 while the rig is open and well.",
            _flag(status.facts is not None and status.fault is None),
        )
        yield GaugeMetricFamily("slrig_rig_held", "1 while something holds the rig.", _flag(status.holder is not None))
        yield GaugeMetricFamily("slrig_rig_waiting", "How many wait for the rig.", status.waiting)

    def _calibration(self) -> Iterator[Metric]:
        health, latest, calibration = self._service.verifications.health()
        states = GaugeMetricFamily("slrig_rig_health", "1 for the state of the rig's health.", labels=["state"])
        for state in HealthState:
            states.add_metric([state], _flag(health.state is state))
        yield states
        if latest is not None:
            yield GaugeMetricFamily(
                "slrig_last_verification_timestamp_seconds", "When the rig was last verified.", latest.at.timestamp()
            )
        solved = None if calibration is None else calibration.solved
        if solved is None:
            return
        age_s = (utc_now() - datetime.fromisoformat(solved.solved_at)).total_seconds()
        yield GaugeMetricFamily("slrig_calibration_age_seconds", "Age of the calibration in use.", age_s)
        yield GaugeMetricFamily(
            "slrig_calibration_expected_error_millimetres",
            "What the calibration in use says of the error of a point in its volume: a standard deviation.",
            solved.expected_error_mm,
        )

    def _schedule(self) -> Iterator[Metric]:
        counts = self._service.schedules.counts()
        # Rows go with their schedule: the numbers may fall.
        runs = GaugeMetricFamily(
            "slrig_scheduled_runs", "Due times on record, by what became of them.", labels=["task", "state"]
        )
        for task in TaskKind:
            for state in RunState:
                runs.add_metric([task, state], counts.get((task, state), 0))
        yield runs
        due = GaugeMetricFamily(
            "slrig_schedule_next_due_timestamp_seconds",
            "When a schedule that is not paused is due next.",
            labels=["schedule", "task"],
        )
        for schedule in self._service.schedules.all():
            if schedule.order.enabled:
                due.add_metric([str(schedule.id), schedule.order.task], schedule.next_due.timestamp())
        yield due


def _flag(held: bool) -> float:
    return 1.0 if held else 0.0
