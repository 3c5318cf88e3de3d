"""Turning heightmaps, so that every grasp becomes a horizontal one (paper, section III-C)."""

from __future__ import annotations

import math

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

    Its tables are buffers, which follow the network from device to device and are in no checkpoint.

    Args:
        shape: Rows and columns of the heightmap.
        count: Angles over half a turn; 1 leaves the heightmap as it is.
        stride: The canvas' sides are multiples of this.
    """

    angles: Tensor
    _centre: Tensor
    _grid: Tensor
    _rows: Tensor
    _cols: Tensor

    def __init__(self, shape: tuple[int, int], count: int, stride: int):
        super().__init__()
        self.shape = shape
        self.count = count
        self.stride = stride
        side = math.hypot(*shape)
        height, width = (math.ceil((n if count == 1 else side) / stride) * stride for n in shape)
        self.canvas = (height, width)
        angles = torch.arange(count) * (math.pi / count)
        # Of the heightmap on the canvas. Not the canvas' own centre: that lies half a pixel beside it where a side is odd.
        centre = torch.tensor([(n - 1) / 2 + (side - n) // 2 for n, side in zip(shape, self.canvas, strict=True)])
        beside = (torch.tensor(self.canvas) - 1) / 2 - centre
        rows, cols = _forward_index(shape, self.canvas, angles, centre)
        tables = {"angles": angles, "_centre": centre, "_rows": rows, "_cols": cols}
        tables["_grid"] = sampling_grid(angles, shape, self.canvas, beside.expand(count, 2))
        for name, table in tables.items():
            self.register_buffer(name, table, persistent=False)

    def all(self, x: Float[Tensor, "1 4 H W"]) -> Float[Tensor, "A 4 h w"]:
        """Every turn of one heightmap."""
        return warp(x.expand(self.count, -1, -1, -1), self._grid)

    def back(self, maps: Float[Tensor, "A 1 h w"]) -> Float[Tensor, "A H W"]:
        """Values of turned maps at the pixels of the original heightmap."""
        index = torch.arange(self.count, device=maps.device)[:, None, None]
        return maps[index, 0, self._rows, self._cols]

    def locate(self, angle: Int[Tensor, " B"], row: Int[Tensor, " B"], col: Int[Tensor, " B"]) -> tuple[Tensor, Tensor]:
        """Row and column on the turned canvas of pixels of the heightmap."""
        return self._rows[angle, row, col], self._cols[angle, row, col]

    def turned(self, x: Float[Tensor, "B 4 H W"], angle: Int[Tensor, " B"]) -> Float[Tensor, "B 4 h w"]:
        """Each heightmap under its own angle."""
        return warp(x, self._grid[angle])

    def window(
        self,
        x: Float[Tensor, "B 4 H W"],
        angle: Int[Tensor, " B"],
        row: Int[Tensor, " B"],
        col: Int[Tensor, " B"],
        reach: int,
        turn: Float[Tensor, " B"] | None = None,
        shift: Float[Tensor, "B 2"] | None = None,
    ) -> tuple[Float[Tensor, "B 4 k k"], Tensor, Tensor]:
        """The part of each turned heightmap that its pixel's logit depends on.

        The window is aligned to the stride and stays on the canvas, so a network whose statistics are fixed gives
        the same logit, and the same gradient, as on the whole canvas.

        Args:
            x: Prepared input.
            angle: Its index.
            row, col: The pixel on the heightmap.
            reach: Of the network; at least as large as the canvas for all of it.
            turn: Radians by which the canvas is turned further, about the pixel.
            shift: Rows and columns of the canvas by which what is beside the pixel is taken for it.

        Returns:
            Windows, and the pixel's row and column within each.
        """
        rows, cols = self.locate(angle, row, col)
        side = math.ceil((2 * reach + self.stride) / self.stride) * self.stride
        height, width = (min(side, n) for n in self.canvas)
        top = self._start(rows, height, self.canvas[0], reach)
        left = self._start(cols, width, self.canvas[1], reach)
        rows, cols = rows - top, cols - left
        corner = torch.stack([top, left], dim=1)
        turn = torch.zeros(len(x), device=x.device) if turn is None else turn
        shift = torch.zeros(len(x), 2, device=x.device) if shift is None else shift
        grid = self._grid_about(torch.stack([rows, cols], dim=1), corner, (height, width), angle, turn, shift)
        return warp(x, grid), rows, cols

    def _start(self, position: Tensor, size: int, extent: int, reach: int) -> Tensor:
        aligned = (position - reach).div(self.stride, rounding_mode="floor") * self.stride
        return aligned.clamp(0, extent - size)

    def _grid_about(
        self, pixel: Tensor, corner: Tensor, size: tuple[int, int], angle: Tensor, turn: Tensor, shift: Tensor
    ) -> Float[Tensor, "B h w 2"]:
        """Of windows of ``size`` at ``corner`` of the canvas, turned about their ``pixel`` and shifted."""
        within = pixel - (torch.tensor(size, device=pixel.device) - 1) / 2
        v, u = (pixel + corner - self._centre + shift).T
        c, s = torch.cos(turn), torch.sin(turn)
        there = torch.stack([c * v + s * u, c * u - s * v], dim=1)
        return sampling_grid(self.angles[angle] + turn, self.shape, size, there - within)


def _forward_index(
    shape: tuple[int, int], canvas: tuple[int, int], angles: Float[Tensor, " A"], centre: Float[Tensor, "2"]
) -> tuple[Int[Tensor, "A H W"], Int[Tensor, "A H W"]]:
    """Row and column on the turned canvas of each pixel of the heightmap."""
    v = torch.arange(shape[0])[None, :, None] - (shape[0] - 1) / 2
    u = torch.arange(shape[1])[None, None, :] - (shape[1] - 1) / 2
    c, s = torch.cos(angles)[:, None, None], torch.sin(angles)[:, None, None]
    rows = s * u + c * v + centre[0]
    cols = c * u - s * v + centre[1]
    return rows.round().long().clamp(0, canvas[0] - 1), cols.round().long().clamp(0, canvas[1] - 1)
