"""Rotation of heightmaps, so that every grasp becomes horizontal (paper, section III-C)."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn


def sampling_grid(
    angles: Float[Tensor, " B"], shape: tuple[int, int], canvas: tuple[int, int], offset: Float[Tensor, "B 2"] | None = None
) -> Float[Tensor, "B h w 2"]:
    """The source position of each pixel of a rotated canvas, in the coordinates of ``grid_sample`` (``align_corners=False``).

    A direction at ``angle`` in the world (counter-clockwise from above; rows grow towards -y) becomes horizontal
    on the canvas. The centres of source and canvas coincide, except for ``offset``.

    Args:
        angles: Radians.
        shape: Rows and columns of the source.
        canvas: Rows and columns of the result.
        offset: Rows and columns by which the centre of each canvas is moved on the rotated image.
    """
    here = angles.device
    rows = torch.arange(canvas[0], dtype=torch.float32, device=here) - (canvas[0] - 1) / 2
    cols = torch.arange(canvas[1], dtype=torch.float32, device=here) - (canvas[1] - 1) / 2
    offset = torch.zeros(len(angles), 2, device=here) if offset is None else offset
    dv = rows[None, :, None] + offset[:, 0, None, None]
    du = cols[None, None, :] + offset[:, 1, None, None]
    c, s = torch.cos(angles)[:, None, None], torch.sin(angles)[:, None, None]
    u, v = c * du + s * dv, c * dv - s * du
    return torch.stack([2 * u / shape[1], 2 * v / shape[0]], dim=-1)


def warp(x: Float[Tensor, "B C H W"], grid: Float[Tensor, "B h w 2"]) -> Float[Tensor, "B C h w"]:
    """Resample prepared input: bilinear for colour, nearest for height (the last channel), zeros outside."""
    color = F.grid_sample(x[:, :-1], grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    return torch.cat([color, warp_nearest(x[:, -1:], grid)], dim=1)


def warp_nearest(x: Float[Tensor, "B C H W"], grid: Float[Tensor, "B h w 2"]) -> Float[Tensor, "B C h w"]:
    """Resample by the nearest pixel, zeros outside."""
    return F.grid_sample(x, grid, mode="nearest", padding_mode="zeros", align_corners=False)


class Rotations(nn.Module):
    """A fixed set of rotations of heightmaps of one shape, and their inverses.

    A rotated heightmap lies on a canvas that contains all of it. Each angle has the smallest such canvas, if the window of the
    network's receptive field fits on all of them; otherwise all angles share the largest one.
    The lookup tables are buffers, so they move to other devices with the module. Checkpoints do not contain them.

    Args:
        shape: Rows and columns of the heightmap.
        count: Number of angles over half a turn; 1 leaves the heightmap as it is.
        stride: The sides of a canvas are multiples of this, pixels.
        receptive_radius: Receptive-field radius of a logit, pixels.
    """

    angles: Tensor
    _extents: Tensor
    _centres: Tensor
    _rows: Tensor
    _cols: Tensor

    def __init__(self, shape: tuple[int, int], count: int, stride: int, receptive_radius: int):
        super().__init__()
        self.shape = shape
        self.count = count
        self.stride = stride
        angles = torch.arange(count) * (math.pi / count)
        canvases = [_canvas(shape, k * math.pi / count, stride) for k in range(count)]
        self.largest = (max(height for height, _ in canvases), max(width for _, width in canvases))
        self._side = math.ceil((2 * receptive_radius + stride) / stride) * stride
        """Side of a window that contains everything a logit depends on, wherever its pixel is relative to the stride."""
        self._receptive_radius = receptive_radius
        own = self._side <= min(min(canvas) for canvas in canvases)
        self.canvases = canvases if own else [self.largest] * count
        """Rows and columns of the canvas, by angle."""
        centres = torch.stack([_centre(shape, canvas) for canvas in self.canvases])
        rows, cols = _forward_index(shape, self.canvases, angles, centres)
        tables = {"angles": angles, "_extents": torch.tensor(self.canvases), "_centres": centres, "_rows": rows, "_cols": cols}
        for name, table in tables.items():
            self.register_buffer(name, table, persistent=False)

    def by_canvas(self, most: int) -> Iterator[tuple[tuple[int, int], Int[Tensor, " n"]]]:
        """Indices of all angles with their canvas, in groups of at most ``most`` that share a canvas."""
        for canvas in dict.fromkeys(self.canvases):
            some = [k for k, other in enumerate(self.canvases) if other == canvas]
            for angles in torch.tensor(some, device=self.angles.device).split(most):
                yield canvas, angles

    def turned(
        self, x: Float[Tensor, "B 4 H W"], angle: Int[Tensor, " B"], canvas: tuple[int, int] | None = None
    ) -> Float[Tensor, "B 4 h w"]:
        """Rotate each heightmap by its own angle, onto ``canvas`` or the largest one."""
        canvas = canvas or self.largest
        # If a side is odd, the heightmap's centre is half a pixel off the canvas' centre.
        beside = (torch.tensor(canvas) - 1) / 2 - _centre(self.shape, canvas)
        grid = sampling_grid(self.angles[angle], self.shape, canvas, beside.to(x.device).expand(len(angle), 2))
        return warp(x.expand(len(angle), -1, -1, -1), grid)

    def back(self, maps: Float[Tensor, "B 1 h w"], angle: Int[Tensor, " B"]) -> Float[Tensor, "B H W"]:
        """Values of rotated maps, each on the canvas of its angle, at the pixels of the original heightmap."""
        index = torch.arange(len(angle), device=maps.device)[:, None, None]
        return maps[index, 0, self._rows[angle], self._cols[angle]]

    def locate(self, angle: Int[Tensor, " B"], row: Int[Tensor, " B"], col: Int[Tensor, " B"]) -> tuple[Tensor, Tensor]:
        """Row and column, on the canvas of the angle, of pixels of the heightmap."""
        return self._rows[angle, row, col], self._cols[angle, row, col]

    def window(
        self,
        x: Float[Tensor, "B 4 H W"],
        angle: Int[Tensor, " B"],
        row: Int[Tensor, " B"],
        col: Int[Tensor, " B"],
        turn: Float[Tensor, " B"] | None = None,
        shift: Float[Tensor, "B 2"] | None = None,
        whole: bool = False,
    ) -> tuple[Float[Tensor, "B 4 k k"], Tensor, Tensor]:
        """The part of each rotated heightmap that the logit of its pixel depends on.

        The window is aligned to the stride and stays on the canvas, so a network with fixed BatchNorm statistics gives
        the same logit, and the same gradient, as on the whole canvas.

        Args:
            x: Prepared input.
            angle: Index of the angle.
            row, col: The pixel on the heightmap.
            turn: Further rotation of the canvas about the pixel, radians.
            shift: Shift of the content, rows and columns of the canvas; the point that far from the pixel moves to it.
            whole: Return the whole of the largest canvas instead.

        Returns:
            Windows, and the pixel's row and column within each.
        """
        pixel = torch.stack(self.locate(angle, row, col), dim=1)
        centre, extent = self._centres[angle], self._extents[angle]
        if whole:
            there = _centre(self.shape, self.largest).to(x.device)
            pixel = pixel + (there - centre).long()
            centre, size = there.expand(len(angle), 2), self.largest
            corner = torch.zeros_like(pixel)
        else:
            size = (min(self._side, self.largest[0]), min(self._side, self.largest[1]))
            aligned = (pixel - self._receptive_radius).div(self.stride, rounding_mode="floor") * self.stride
            corner = torch.minimum(aligned.clamp(min=0), extent - torch.tensor(size, device=x.device))
        pixel = pixel - corner
        turn = torch.zeros(len(x), device=x.device) if turn is None else turn
        shift = torch.zeros(len(x), 2, device=x.device) if shift is None else shift
        grid = self._grid_about(pixel, corner - centre + shift, size, angle, turn)
        return warp(x, grid), pixel[:, 0], pixel[:, 1]

    def _grid_about(
        self, pixel: Tensor, corner: Tensor, size: tuple[int, int], angle: Tensor, turn: Tensor
    ) -> Float[Tensor, "B h w 2"]:
        """Sampling grid of windows of ``size``, rotated by ``turn`` about their ``pixel``.

        ``corner`` is the position of the window's corner relative to the heightmap's centre, rows and columns.
        """
        within = pixel - (torch.tensor(size, device=pixel.device) - 1) / 2
        v, u = (pixel + corner).T
        c, s = torch.cos(turn), torch.sin(turn)
        there = torch.stack([c * v + s * u, c * u - s * v], dim=1)
        return sampling_grid(self.angles[angle] + turn, self.shape, size, there - within)


def _canvas(shape: tuple[int, int], angle: float, stride: int) -> tuple[int, int]:
    """Rows and columns of the smallest canvas that contains a heightmap rotated by an angle."""
    c, s = abs(math.cos(angle)), abs(math.sin(angle))
    sides = shape[0] * c + shape[1] * s, shape[1] * c + shape[0] * s
    # A side that is a multiple of the stride except for rounding errors is not enlarged.
    height, width = (math.ceil(round(side / stride, 6)) * stride for side in sides)
    return height, width


def _centre(shape: tuple[int, int], canvas: tuple[int, int]) -> Float[Tensor, "2"]:
    """Row and column of the heightmap's centre on a canvas. They are chosen so that an angle of 0 shifts it by whole pixels."""
    return torch.tensor([(n - 1) / 2 + (side - n) // 2 for n, side in zip(shape, canvas, strict=True)])


def _forward_index(
    shape: tuple[int, int], canvases: list[tuple[int, int]], angles: Float[Tensor, " A"], centres: Float[Tensor, "A 2"]
) -> tuple[Int[Tensor, "A H W"], Int[Tensor, "A H W"]]:
    """Row and column of each pixel of the heightmap on the canvas of each angle."""
    v = torch.arange(shape[0])[None, :, None] - (shape[0] - 1) / 2
    u = torch.arange(shape[1])[None, None, :] - (shape[1] - 1) / 2
    c, s = torch.cos(angles)[:, None, None], torch.sin(angles)[:, None, None]
    places = (s * u + c * v, c * u - s * v)
    ends = torch.tensor(canvases) - 1
    rows, cols = (
        torch.minimum((place + centres[:, i, None, None]).round().long().clamp(min=0), ends[:, i, None, None])
        for i, place in enumerate(places)
    )
    return rows, cols
