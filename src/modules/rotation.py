"""Turning heightmaps, so that every grasp becomes a horizontal one (paper, section III-C)."""

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
    """Where each pixel of a turned canvas comes from, in ``grid_sample``'s coordinates (``align_corners=False``).

    A direction at ``angle`` in the world (counter-clockwise from above; rows grow towards -y) becomes horizontal
    on the canvas. Centres coincide, but for ``offset``.

    Args:
        angles: Radians.
        shape: Rows and columns of the source.
        canvas: Rows and columns of the result.
        offset: Rows and columns by which each canvas' centre is moved on the turned image.
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
    """Resample prepared input: colour bilinear, height (the last channel) nearest, zeros outside."""
    color = F.grid_sample(x[:, :-1], grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    return torch.cat([color, warp_nearest(x[:, -1:], grid)], dim=1)


def warp_nearest(x: Float[Tensor, "B C H W"], grid: Float[Tensor, "B h w 2"]) -> Float[Tensor, "B C h w"]:
    """Resample by the nearest pixel, zeros outside."""
    return F.grid_sample(x, grid, mode="nearest", padding_mode="zeros", align_corners=False)


class Rotations(nn.Module):
    """A fixed set of turns of heightmaps of one shape, with the way back to their pixels.

    A turned heightmap lies on a canvas that holds all of it. The canvas of an angle is no larger than that needs, if the
    network's reach leaves room for a window on each of them; else all angles share the largest.
    Its tables are buffers, which follow the network from device to device and are in no checkpoint.

    Args:
        shape: Rows and columns of the heightmap.
        count: Angles over half a turn; 1 leaves the heightmap as it is.
        stride: The sides of a canvas are multiples of this.
        reach: Pixels around a logit that can influence it, on each side.
    """

    angles: Tensor
    _extents: Tensor
    _centres: Tensor
    _rows: Tensor
    _cols: Tensor

    def __init__(self, shape: tuple[int, int], count: int, stride: int, reach: int):
        super().__init__()
        self.shape = shape
        self.count = count
        self.stride = stride
        angles = torch.arange(count) * (math.pi / count)
        canvases = [_canvas(shape, k * math.pi / count, stride) for k in range(count)]
        self.largest = (max(height for height, _ in canvases), max(width for _, width in canvases))
        self._side = math.ceil((2 * reach + stride) / stride) * stride
        """Of a window that holds what a logit depends on, wherever its pixel is within the stride."""
        self._reach = reach
        own = self._side <= min(min(canvas) for canvas in canvases)
        self.canvases = canvases if own else [self.largest] * count
        """Rows and columns, by angle."""
        centres = torch.stack([_centre(shape, canvas) for canvas in self.canvases])
        rows, cols = _forward_index(shape, self.canvases, angles, centres)
        tables = {"angles": angles, "_extents": torch.tensor(self.canvases), "_centres": centres, "_rows": rows, "_cols": cols}
        for name, table in tables.items():
            self.register_buffer(name, table, persistent=False)

    def by_canvas(self, most: int) -> Iterator[tuple[tuple[int, int], Int[Tensor, " n"]]]:
        """All angles, as indices, at most so many at once, those of one canvas together."""
        for canvas in dict.fromkeys(self.canvases):
            some = [k for k, other in enumerate(self.canvases) if other == canvas]
            for angles in torch.tensor(some, device=self.angles.device).split(most):
                yield canvas, angles

    def turned(
        self, x: Float[Tensor, "B 4 H W"], angle: Int[Tensor, " B"], canvas: tuple[int, int] | None = None
    ) -> Float[Tensor, "B 4 h w"]:
        """Each heightmap under its own angle, on the largest canvas or a smaller one."""
        canvas = canvas or self.largest
        # The heightmap's centre is not the canvas' own where a side is odd: that lies half a pixel beside it.
        beside = (torch.tensor(canvas) - 1) / 2 - _centre(self.shape, canvas)
        grid = sampling_grid(self.angles[angle], self.shape, canvas, beside.to(x.device).expand(len(angle), 2))
        return warp(x.expand(len(angle), -1, -1, -1), grid)

    def back(self, maps: Float[Tensor, "B 1 h w"], angle: Int[Tensor, " B"]) -> Float[Tensor, "B H W"]:
        """Values of turned maps, each on the canvas of its angle, at the pixels of the original heightmap."""
        index = torch.arange(len(angle), device=maps.device)[:, None, None]
        return maps[index, 0, self._rows[angle], self._cols[angle]]

    def locate(self, angle: Int[Tensor, " B"], row: Int[Tensor, " B"], col: Int[Tensor, " B"]) -> tuple[Tensor, Tensor]:
        """Row and column of pixels of the heightmap on the canvas of their angle."""
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
        """The part of each turned heightmap that its pixel's logit depends on.

        The window is aligned to the stride and stays on the canvas, so a network whose statistics are fixed gives
        the same logit, and the same gradient, as on the whole canvas.

        Args:
            x: Prepared input.
            angle: Its index.
            row, col: The pixel on the heightmap.
            turn: Radians by which the canvas is turned further, about the pixel.
            shift: Rows and columns of the canvas by which what is beside the pixel is taken for it.
            whole: All of the largest canvas instead.

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
            aligned = (pixel - self._reach).div(self.stride, rounding_mode="floor") * self.stride
            corner = torch.minimum(aligned.clamp(min=0), extent - torch.tensor(size, device=x.device))
        pixel = pixel - corner
        turn = torch.zeros(len(x), device=x.device) if turn is None else turn
        shift = torch.zeros(len(x), 2, device=x.device) if shift is None else shift
        grid = self._grid_about(pixel, corner - centre + shift, size, angle, turn)
        return warp(x, grid), pixel[:, 0], pixel[:, 1]

    def _grid_about(
        self, pixel: Tensor, corner: Tensor, size: tuple[int, int], angle: Tensor, turn: Tensor
    ) -> Float[Tensor, "B h w 2"]:
        """Of windows of ``size``, turned about their ``pixel``, whose ``corner`` is so far from the heightmap's centre."""
        within = pixel - (torch.tensor(size, device=pixel.device) - 1) / 2
        v, u = (pixel + corner).T
        c, s = torch.cos(turn), torch.sin(turn)
        there = torch.stack([c * v + s * u, c * u - s * v], dim=1)
        return sampling_grid(self.angles[angle] + turn, self.shape, size, there - within)


def _canvas(shape: tuple[int, int], angle: float, stride: int) -> tuple[int, int]:
    """Rows and columns that hold a heightmap under an angle."""
    c, s = abs(math.cos(angle)), abs(math.sin(angle))
    sides = shape[0] * c + shape[1] * s, shape[1] * c + shape[0] * s
    # What is a multiple but for rounding is not enlarged.
    height, width = (math.ceil(round(side / stride, 6)) * stride for side in sides)
    return height, width


def _centre(shape: tuple[int, int], canvas: tuple[int, int]) -> Float[Tensor, "2"]:
    """Row and column of the heightmap's centre on a canvas, such that an angle of 0 moves it by whole pixels."""
    return torch.tensor([(n - 1) / 2 + (side - n) // 2 for n, side in zip(shape, canvas, strict=True)])


def _forward_index(
    shape: tuple[int, int], canvases: list[tuple[int, int]], angles: Float[Tensor, " A"], centres: Float[Tensor, "A 2"]
) -> tuple[Int[Tensor, "A H W"], Int[Tensor, "A H W"]]:
    """Row and column on the canvas of its angle of each pixel of the heightmap."""
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
