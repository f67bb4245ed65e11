# SPDX-License-Identifier: Apache-2.0
"""Put our cloud, and the recording's LiDAR, through Nav2's voxel marking and ray clearing, and draw both costmaps.

    python tools/costmap_trial.py ../shared/data/pandaset_002 --start 2.93 -o costmap.png

The costmap is an implementation of its own, with the parameters of config/consumers/nav2_costmap.yaml: it knows points
and where their rays begin, and nothing of ours. Every set clears and marks from where the vehicle was, as in Nav2. The
picture has, from left to right: a cloud with sky and without a ground, of which all marks that is 0.2 to 2 m above the
rig's ground; our obstacles; the LiDAR's. Taken is red, free is green, x upwards, rings at 5, 10 and 20 m. It also
prints how many squares within 20 m are taken in one and free in the other.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from cvcdepth_core.obstacles.separation import ObstacleLimits, separate
from cvcdepth_core.pointcloud import CloudLimits, merged_cloud
from cvcdepth_core.rig.rig import Rig
from cvcdepth_core.rig.rig_file import load_rig_layout
from cvcdepth_core.surround_depth import SurroundDepth
from cvcdepth_ros.evaluation.job import EvaluationJob, EvaluationSettings
from cvcdepth_ros.evaluation.measuring import MeasuredSet, open_evaluation

LAYER_FILE = Path(__file__).resolve().parents[1] / "config" / "consumers" / "nav2_costmap.yaml"
FREE, TAKEN, UNKNOWN = 0, 254, 255

_PIXELS = 5  # of the picture for a square
_COLOURS = {FREE: (70, 110, 70), TAKEN: (80, 80, 255), UNKNOWN: (24, 20, 18)}  # BGR


class Observation(NamedTuple):
    """What a source of the layer saw at once."""

    points: NDArray[np.float64]
    """[M, 3] metres in the costmap's frame."""
    origin: NDArray[np.float64]
    """[3] where the rays to them begin."""


class VoxelCostmap:
    """Columns of voxels: points mark theirs, rays to points clear those on the way."""

    def __init__(self, layer: Mapping[str, Any], size: float, resolution: float) -> None:
        """`layer` has the voxel layer's parameters, `size` and `resolution` are in metres; all is unknown at first."""
        self._layer, self._resolution, self._half = layer, resolution, size / 2
        cells = round(size / resolution)
        self._marked = np.zeros((cells, cells, layer["z_voxels"]), dtype=np.bool_)
        self._known = np.zeros_like(self._marked)

    @classmethod
    def from_file(cls, path: Path = LAYER_FILE) -> VoxelCostmap:
        """Return the costmap that a file with Nav2's parameters describes."""
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        parameters = content["local_costmap"]["local_costmap"]["ros__parameters"]
        return cls(parameters["voxel_layer"], parameters["width"], parameters["resolution"])

    def update(self, seen: Mapping[str, Observation]) -> None:
        """Clear with all sources that do, then mark with all that do; `seen` is by source."""
        taken = {source: self._between(source, one) for source, one in seen.items()}
        for source, (points, origin) in taken.items():
            if self._layer[source]["clearing"]:
                self._clear(points, origin, self._layer[source]["raytrace_max_range"])
        for source, (points, origin) in taken.items():
            if self._layer[source]["marking"]:
                near = np.linalg.norm(points - origin, axis=1) <= self._layer[source]["obstacle_max_range"]
                self._set(self._cells(points[near]), marked=True)

    def costs(self) -> NDArray[np.uint8]:
        """Return each square's cost [x, y]."""
        costs = np.where(self._known.any(axis=2), FREE, UNKNOWN)
        return np.where(self._marked.sum(axis=2) > self._layer["mark_threshold"], TAKEN, costs).astype(np.uint8)

    def cost(self, x: float, y: float) -> int:
        """Return the cost of the square at a place, metres."""
        column, row = self._cells(np.array([[x, y, 0.0]]))[0, :2].tolist()
        return int(self.costs()[column, row])

    def _between(self, source: str, seen: Observation) -> Observation:
        low, high = (self._layer[source][f"{end}_obstacle_height"] for end in ("min", "max"))
        z = seen.points[:, 2]
        return seen._replace(points=seen.points[(z >= low) & (z <= high)])

    def _clear(self, points: NDArray[np.float64], origin: NDArray[np.float64], reach: float) -> None:
        """Clear what the rays cross before their ends, in steps of half a square."""
        offsets, ends = points - origin, self._cells(points)
        lengths = np.linalg.norm(offsets, axis=1)
        for way in np.arange(0.0, reach, 0.5 * self._resolution):
            on_way = way < lengths
            cells = self._cells(origin + offsets[on_way] * (way / lengths[on_way])[:, None])
            self._set(cells[(cells != ends[on_way]).any(axis=1)], marked=False)

    def _set(self, cells: NDArray[np.int64], marked: bool) -> None:
        inside = ((cells >= 0) & (cells < self._marked.shape)).all(axis=1)
        places = tuple(cells[inside].T)
        self._marked[places], self._known[places] = marked, True

    def _cells(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        flat = (points[:, :2] + self._half) / self._resolution
        high = (points[:, 2:] - self._layer["origin_z"]) / self._layer["z_resolution"]
        return np.floor(np.concatenate([flat, high], axis=1)).astype(np.int64)


def main() -> None:
    """Draw the costmaps of the last set."""
    options = parse_options()
    settings = EvaluationSettings.model_validate({"checkpoint": options.checkpoint, "refine": options.refine})
    layout = load_rig_layout(options.rig) if options.rig else None
    job = EvaluationJob("trial", str(options.recording), settings, layout, start=options.start)
    with open_evaluation(job) as evaluation:
        maps = costmaps(evaluation.sets(*evaluation.window))
    compared = {name: disagreement(found, maps["LiDAR"]) for name, found in maps.items() if name != "LiDAR"}
    for name, (invented, missed) in compared.items():
        print(f"{name}: {invented} squares taken where the LiDAR's are free, {missed} free where they are taken")
    cv2.imwrite(str(options.output), np.hstack([drawn(found) for found in maps.values()]))


def parse_options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--checkpoint", default="default")
    parser.add_argument("--refine", default="off", choices=["off", "geometry"])
    parser.add_argument("--rig", type=Path, help="rig file")
    parser.add_argument("--start", type=float, default=0.0, metavar="S", help="seconds of the recording to skip")
    parser.add_argument("-o", "--output", type=Path, default=Path("costmap.png"))
    return parser.parse_args()


def costmaps(sets: Iterator[MeasuredSet]) -> dict[str, NDArray[np.uint8]]:
    """Return the costs [x, y] around the vehicle's last place, by what made them."""
    measured = list(sets)
    maps = {name: VoxelCostmap.from_file() for name in ("before", "ours", "LiDAR")}
    for one in measured:
        rig, result = one.estimated.rig, one.estimated.result
        place = _in_last_frame(one, measured[-1])
        maps["before"].update(_moved(_everything(result, rig), place))
        maps["ours"].update(_moved(_observed(_cloud(result, rig), rig), place))
        if one.lidar is not None:
            maps["LiDAR"].update(_moved(_observed(one.lidar, rig), place))
    return {name: found.costs() for name, found in maps.items()}


def disagreement(one: NDArray[np.uint8], other: NDArray[np.uint8], reach: float = 20.0) -> tuple[int, int]:
    """Return how many squares within `reach` metres are taken in one and free in the other, both ways."""
    middles = (np.arange(len(one)) + 0.5 - len(one) / 2) * (40.0 / len(one))
    near = np.hypot(middles[:, None], middles[None]) <= reach
    first = near & (one == TAKEN) & (other == FREE)
    return int(first.sum()), int((near & (one == FREE) & (other == TAKEN)).sum())


def drawn(costs: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Draw a costmap, x upwards and y to the left."""
    picture = np.zeros((*costs.shape, 3), np.uint8)
    for cost, colour in _COLOURS.items():
        picture[costs == cost] = colour
    picture = cv2.resize(picture[::-1, ::-1], None, fx=_PIXELS, fy=_PIXELS, interpolation=cv2.INTER_NEAREST)
    middle = picture.shape[0] // 2
    for metres in (5, 10, 20):
        cv2.circle(picture, (middle, middle), round(metres * picture.shape[0] / 40), (150, 150, 150), 1)
    return np.pad(picture, ((0, 0), (0, 6), (0, 0)))


def _cloud(result: SurroundDepth, rig: Rig) -> NDArray[np.float64]:
    return merged_cloud(result, rig, CloudLimits(2, 0.5, 40.0, voxel=0.2))[:, :3].astype(np.float64)


def _everything(result: SurroundDepth, rig: Rig) -> dict[str, Observation]:
    """Return what a costmap gets of a plain cloud: all points mark that are 0.2 to 2 m above the rig's ground."""
    points = _cloud(replace(result, sky=None), rig)
    heights = points[:, 2] - rig.ground_z
    return _above_ground(points, points[(heights >= 0.2) & (heights <= 2.0)], rig.ground_z, rig)


def _observed(points: NDArray[np.floating], rig: Rig) -> dict[str, Observation]:
    """Return what the layer's sources get: obstacles, and all points, above the ground that is found."""
    found = separate(points.astype(np.float32), rig.ground_z, ObstacleLimits())
    return _above_ground(points.astype(np.float64), found.obstacles[:, :3].astype(np.float64), found.plane.height, rig)


def _above_ground(
    points: NDArray[np.float64], obstacles: NDArray[np.float64], ground: float, rig: Rig
) -> dict[str, Observation]:
    """Put points into a frame whose z = 0 is the ground, as a costmap's usually is."""
    down = np.array([0.0, 0.0, ground])
    camera = rig.cameras[rig.names.index(rig.anchor)].base_T_camera[:3, 3] - down
    return {"obstacles": Observation(obstacles - down, camera), "points": Observation(points - down, camera)}


def _in_last_frame(one: MeasuredSet, last: MeasuredSet) -> NDArray[np.float64]:
    if one.world_T_base is None or last.world_T_base is None:
        return np.eye(4)
    anchor = one.estimated.rig.names.index(one.estimated.surround_set.anchor)
    return np.linalg.inv(last.world_T_base[anchor]) @ one.world_T_base[anchor]


def _moved(seen: Mapping[str, Observation], pose: NDArray[np.float64]) -> dict[str, Observation]:
    rotation, shift = pose[:3, :3], pose[:3, 3]
    return {n: Observation(o.points @ rotation.T + shift, rotation @ o.origin + shift) for n, o in seen.items()}


if __name__ == "__main__":
    main()
