"""One scale for the colours of several views: each scan has its own, by the brightest that it saw.

A place that two views saw well has one albedo, so that the median of their ratio is that of their scales. The gains
g_v minimise Σ n_ij (log g_i - log g_j + median log(l_i / l_j))² over pairs with n_ij places in common, and the largest
is 1: the view that saw the brightest part had to be brightened least.
"""

from __future__ import annotations

import numpy as np

from slrig.model import AlbedoMark, FloatArray, IntArray
from slrig.model.srgb import light_of, srgb_of
from slrig.views.fusion_sheets import Sheets

_SAMPLED = 50_000  # places: of a twentieth of them a median is known to a per cent
_FEWEST_SHARED = 100  # places of two views: fewer tell nothing
_DARKEST = 0.01  # of white: an sRGB step is then a tenth of the light


def to_one_scale(sheets: Sheets, nearest: IntArray) -> FloatArray:
    """Bring the colours of the views to one scale, where they are, and return the gains, (V,), at most 1.

    nearest : (V, n) int32, the views' nearest triangles to points of the surface, -1 for none. A view that shares too
    little without a mark keeps its own.
    """
    places = nearest[:, :: nearest.shape[1] // _SAMPLED + 1]
    vertex = sheets.faces[:, 0][places]
    light = light_of(sheets.colour).max(axis=1)[vertex] / light_of(np.array([255], np.uint8))
    sound = (places >= 0) & (sheets.mark[vertex] == AlbedoMark.NONE) & (light > _DARKEST)
    logs = np.log(np.where(sound, light, 1.0))
    count = len(places)
    rows, sides = [np.zeros((1, count))], [0.0]
    for i in range(count):
        for j in range(i):
            both = sound[i] & sound[j]
            shared = np.count_nonzero(both)
            if shared >= _FEWEST_SHARED:
                weight = np.sqrt(shared)
                rows.append(weight * (np.eye(count)[i : i + 1] - np.eye(count)[j : j + 1]))
                sides.append(-weight * float(np.median(logs[i, both] - logs[j, both])))
    # The shortest of all solutions: views that nothing joins have no gain.
    found = np.linalg.lstsq(np.concatenate(rows), np.array(sides), rcond=None)[0]
    gains = np.exp(found - found.max())
    levels = np.arange(256, dtype=np.uint8)
    for view, gain in enumerate(gains):
        mine = sheets.colour[sheets.first_vertex[view] : sheets.first_vertex[view + 1]]
        mine[:] = srgb_of(gain * light_of(levels) / light_of(levels[-1:]))[mine]
    return np.asarray(gains)
