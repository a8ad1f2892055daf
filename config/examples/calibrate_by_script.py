"""Calibrate a rig whose positioner holds the board: capture a pose at every position, solve, use a good result.

slrig serve rendered-calibration
SLRIG_API_KEY=... python config/examples/calibrate_by_script.py charuco 11 8 14 --marker-mm 10.5
"""

import argparse
from typing import Any

from slrig.client import Client

ONGOING = {"queued", "capturing", "computing", "solving"}


def main(board: dict[str, Any], most_error_mm: float) -> None:
    """Calibrate with `board`; activate the result where the expected error of a point is at most `most_error_mm`."""
    with Client() as client:
        session = client.calibration.open(board=board, label="by script")
        client.calibration.script(session["id"], if_busy="queue")
        for pose in wait(client, session["id"])["shot"]:
            fault = f": {pose['error']['detail']}" if pose["error"] else ""
            print(f"pose {pose['number']}: {pose['state']}{fault}")
        client.calibration.solve(session["id"])
        solved = wait(client, session["id"])
        if solved["result"] is None:
            raise SystemExit(f"no solution: {solved['error']['detail']}")
        error_mm = solved["result"]["expected"]["point_mm"]
        print(f"{solved['verdict']} Expected error of a point: {error_mm:.4f} mm")
        if error_mm <= most_error_mm:
            client.calibration.activate(session["id"])
            print(f"calibration {session['id']} is in use")


def wait(client: Client, calibration_id: str) -> dict[str, Any]:
    """The calibration once no job of it is left."""
    while True:
        for _ in client.calibration.follow(calibration_id):
            pass
        found = client.calibration.get(calibration_id)
        if not found["script"] and not ONGOING & {found["state"], *(pose["state"] for pose in found["shot"])}:
            return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=["charuco", "chessboard", "circles"])
    parser.add_argument(
        "columns", type=int, help="of inner corners; for charuco and circles as `slrig calibrate` has them"
    )
    parser.add_argument("rows", type=int)
    parser.add_argument("square_mm", type=float)
    parser.add_argument("--marker-mm", type=float)
    parser.add_argument("--most-error-mm", type=float, default=0.1)
    given = parser.parse_args()
    described = {"kind": given.kind, "corners": [given.columns, given.rows], "square_mm": given.square_mm}
    main(described | ({"marker_mm": given.marker_mm} if given.marker_mm else {}), given.most_error_mm)
