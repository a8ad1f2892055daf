"""Scan an object from all sides on the rig's turntable, combine the views, and fetch the model.

slrig serve turntable
SLRIG_API_KEY=... python config/examples/several_views.py 8 model.ply
"""

import sys

from slrig.client import Client, Progress


def main(views: int, output: str, axis: dict[str, list[float]] | None) -> None:
    """Scan `views` views at equal angles, and write their model to `output`."""
    with Client() as client:
        model = client.models.shoot(views=views, axis=axis, label=f"{views} views", if_busy="queue")
        for event in client.models.follow(model["id"]):
            if isinstance(event, Progress):
                print(f"{event.fraction:4.0%} {event.stage} {event.detail}")
        model = client.models.wait(model["id"])
        client.fetch(model["links"]["files"]["model.ply"], output)
        print(f"{output}: {model['summary']}")


if __name__ == "__main__":
    numbers = [float(word) for word in sys.argv[3:9]]
    main(int(sys.argv[1]), sys.argv[2], {"point_mm": numbers[:3], "direction": numbers[3:]} if numbers else None)
