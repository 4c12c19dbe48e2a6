"""Parameter sets to token sequences and back (paper, section 4.3).

A building with n vertices is ::

    [start] [height] d d d d  ( [point] [x] ± d d d d [y] ± d d d d [angle] d d ) * n  [end]

where ``d`` at place j is the token d * 10^j, as in the Regression Transformer (Born and Manica, 2022). With
four digits per length and two per angle the sequence has 7 + 16 n tokens from a vocabulary of 51. It starts at
the uppermost-left vertex (largest y, then smallest x; compared as quantised integers, because vertices of
axis-aligned buildings tie exactly) and goes round counter-clockwise. The angle after a vertex is that of the edge
that leaves it.

All functions work on batches of padded tensors, of which each row is valid up to its ``num_vertices``.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

SPECIAL = (
    "[pad]",
    "[mask]",
    "[start]",
    "[end]",
    "[height]",
    "[angle]",
    "[point]",
    "[x]",
    "[y]",
    "[+]",
    "[-]",
)
PAD, MASK, START, END, HEIGHT, ANGLE, POINT, X, Y, PLUS, MINUS = range(len(SPECIAL))
FIRST_DIGIT = len(SPECIAL)

# the kinds of positions of a sequence
KIND_PAD, KIND_FRAME, KIND_TYPE, KIND_SIGN, KIND_HEIGHT, KIND_COORDINATE, KIND_ANGLE = range(7)


@dataclass(frozen=True)
class Quantised:
    """Quantised parameter sets of a batch, in canonical order.

    height: int64 (b,), units of 10^-height_decimals m. xy: int64 (b, n, 2), units of 10^-coord_decimals m.
    angle: int64 (b, n), degrees. num_vertices: int64 (b,). Values beyond ``num_vertices`` are 0.
    """

    height: Tensor
    xy: Tensor
    angle: Tensor
    num_vertices: Tensor


class Tokenizer:
    """The bijection between canonical, quantised parameter sets and token sequences.

    ``coord_decimals`` 2 is the paper's reading (centimetres), 1 saves two tokens per vertex. ``hundreds``
    adds the place 10^2 to heights and coordinates: without it both stay below 100 m.
    """

    def __init__(self, coord_decimals: int = 2, hundreds: bool = False) -> None:
        top = 2 if hundreds else 1
        self.places = tuple(range(top, -3, -1))
        self.coord_decimals = coord_decimals
        self.coord_places = tuple(place for place in self.places if place >= -coord_decimals)
        self.angle_places = (1, 0)
        self.vocabulary_size = FIRST_DIGIT + 10 * len(self.places)
        self.vocabulary = SPECIAL + tuple(
            f"[{digit}·10^{place}]" for place in self.places for digit in range(10)
        )
        self.max_height = 10 ** len(self.places) - 1
        self.max_coord = 10 ** len(self.coord_places) - 1
        # distance from the origin at which a vertex fits the number format in every rotation
        self.reach_m = self.max_coord * 10.0**-coord_decimals

        header = [(START, KIND_FRAME), (HEIGHT, KIND_TYPE)] + [(MASK, KIND_HEIGHT)] * len(self.places)
        axis = [(PLUS, KIND_SIGN)] + [(MASK, KIND_COORDINATE)] * len(self.coord_places)
        block = [(POINT, KIND_TYPE), (X, KIND_TYPE), *axis, (Y, KIND_TYPE), *axis, (ANGLE, KIND_TYPE)]
        block += [(MASK, KIND_ANGLE)] * len(self.angle_places)
        self.header_length = len(header)
        self.block_length = len(block)
        self._header = torch.tensor(header).T
        self._block = torch.tensor(block).T
        # slots within a vertex block
        self.x_slot, self.y_slot = 2, 4 + len(self.coord_places)
        self.angle_slot = self.block_length - len(self.angle_places)
        # the number that each token stands for, 0 for those that are not digits
        self.token_value = torch.tensor(
            [0.0] * FIRST_DIGIT + [digit * 10.0**place for place in self.places for digit in range(10)],
            device="cpu",  # also of a network that is built without memory
        )

    # --- quantise, canonical order ---

    def quantise(self, height_m: Tensor, xy_m: Tensor, angle_deg: Tensor, num_vertices: Tensor) -> Quantised:
        """Round metres and degrees; arguments (b,), (b, n, 2), (b, n), (b,). Not yet in canonical order."""
        inside = _inside(num_vertices, xy_m.shape[1])
        return Quantised(
            height=torch.round(height_m.double() * 10 ** -self.places[-1]).long(),
            xy=torch.round(xy_m.double() * 10**self.coord_decimals).long() * inside[..., None],
            angle=torch.round(angle_deg.double()).long() * inside,
            num_vertices=num_vertices,
        )

    def canonical(self, parameters: Quantised) -> tuple[Quantised, Tensor]:
        """Roll each ring to its uppermost-left vertex, angles with it.

        Returns the parameters and the start (b,): canonical vertex i is the input's vertex (start + i) mod n.
        """
        num_vertices = parameters.num_vertices
        inside = _inside(num_vertices, parameters.xy.shape[1])
        # y first, then -x: one integer key, larger is earlier
        key = parameters.xy[..., 1] * (4 * self.max_coord) - parameters.xy[..., 0]
        start = key.masked_fill(~inside, torch.iinfo(torch.int64).min).argmax(1)
        order = roll_index(start, num_vertices, parameters.xy.shape[1])
        return (
            Quantised(
                height=parameters.height,
                xy=parameters.xy.gather(1, order[..., None].expand(-1, -1, 2)) * inside[..., None],
                angle=parameters.angle.gather(1, order) * inside,
                num_vertices=num_vertices,
            ),
            start,
        )

    # --- tokens ---

    def encode(self, parameters: Quantised) -> Tensor:
        """int64 (b, length(n)) tokens of canonical parameters, padded with [pad].

        Raises ``ValueError`` where a value does not fit its digits.
        """
        fits = (
            (parameters.height >= 0)
            & (parameters.height <= self.max_height)
            & (parameters.xy.abs().amax((1, 2)) <= self.max_coord)
            & ((parameters.angle >= 0) & (parameters.angle <= 99)).all(1)
        )
        if not bool(fits.all()):
            raise ValueError("a height, coordinate or angle does not fit the number format")
        device = parameters.xy.device
        batch, n = parameters.angle.shape
        header = self._header[0].to(device, non_blocking=True).expand(batch, -1).clone()
        header[:, 2:] = self._digits(parameters.height, self.places)
        block = self._block[0].to(device, non_blocking=True).expand(batch, n, -1).clone()
        for axis, slot in ((0, self.x_slot), (1, self.y_slot)):
            value = parameters.xy[..., axis]
            block[..., slot] = torch.where(value < 0, MINUS, PLUS)
            block[..., slot + 1 : slot + 1 + len(self.coord_places)] = self._digits(
                value.abs(), self.coord_places
            )
        block[..., self.angle_slot :] = self._digits(parameters.angle, self.angle_places)
        tokens = torch.cat([header, block.flatten(1), header.new_full((batch, 1), PAD)], 1)
        end = self.header_length + self.block_length * parameters.num_vertices
        position = torch.arange(tokens.shape[1], device=device)
        tokens = tokens.masked_fill(position >= end[:, None], PAD)
        return tokens.scatter(1, end[:, None], END)

    def blocks(self, tokens: Tensor) -> Tensor:
        """(b, n, block_length): the tokens between the header and the last position, per vertex; a view."""
        return tokens[:, self.header_length : -1].unflatten(1, (-1, self.block_length))

    def length(self, num_vertices: int) -> int:
        """Length of the sequence of a building with ``num_vertices`` vertices."""
        return self.header_length + self.block_length * num_vertices + 1

    def kinds(self, tokens_shape: torch.Size, num_vertices: Tensor) -> Tensor:
        """int64 (b, l): the kind of each position, one of the ``KIND_`` constants."""
        device = num_vertices.device
        n = (tokens_shape[1] - self.header_length - 1) // self.block_length
        parts = [self._header[1], self._block[1].repeat(n), torch.tensor([KIND_PAD])]
        kind = torch.cat(parts).to(device, non_blocking=True)
        end = self.header_length + self.block_length * num_vertices[:, None]
        position = torch.arange(tokens_shape[1], device=device)
        kind = kind.expand(len(num_vertices), -1).masked_fill(position >= end, KIND_PAD)
        return kind.masked_fill(position == end, KIND_FRAME)

    def mask_targets(self, parameters: Quantised) -> tuple[Tensor, Tensor]:
        """The sequence of inference (section 4.3), in which the digits of height and angles are [mask].

        ``height`` and ``angle`` of the argument are ignored. Returns tokens (b, l) and kinds (b, l).
        """
        empty = Quantised(
            torch.zeros_like(parameters.height),
            parameters.xy,
            torch.zeros_like(parameters.angle),
            parameters.num_vertices,
        )
        tokens = self.encode(empty)
        kind = self.kinds(tokens.shape, parameters.num_vertices)
        return tokens.masked_fill((kind == KIND_HEIGHT) | (kind == KIND_ANGLE), MASK), kind

    def target_positions(self, n: int) -> Tensor:
        """int64 (r,): the positions that inference predicts: the digits of the height, then those of the angles of n
        vertices, edge by edge."""
        kind = torch.cat([self._header[1], self._block[1].repeat(n)])
        return torch.cat([(kind == KIND_HEIGHT).nonzero()[:, 0], (kind == KIND_ANGLE).nonzero()[:, 0]])

    def digits(self, length: int) -> tuple[Tensor, Tensor]:
        """Two rows int64 (length,) for the positions of sequences of this ``length``: the index in ``places`` of the
        digit's place, -1 without a digit; and how many digits of the same number stand before it, 0 without a digit."""
        block = [(self.x_slot + 1, self.coord_places), (self.y_slot + 1, self.coord_places)]
        block += [(self.angle_slot, self.angle_places)]
        header = [(self.header_length - len(self.places), self.places)]
        layout = torch.stack([torch.full((length,), -1), torch.zeros(length, dtype=torch.int64)])
        for row, numbers in ((layout[:, : self.header_length], header), (self.blocks(layout), block)):
            for slot, places in numbers:
                index = torch.tensor([self.places.index(place) for place in places])
                row[0, ..., slot : slot + len(places)] = index
                row[1, ..., slot : slot + len(places)] = torch.arange(len(places))
        return layout[0], layout[1]

    def _digits(self, value: Tensor, places: tuple[int, ...]) -> Tensor:
        """(..., len(places)): digit tokens of non-negative integers in units of the last place."""
        last = places[-1]
        digits = [value // 10 ** (each - last) % 10 + self.digit_tokens(each).start for each in places]
        return torch.stack(digits, -1)

    def digit_tokens(self, place: int) -> slice:
        """The ten digit tokens of a place, as a slice of the vocabulary."""
        first = FIRST_DIGIT + 10 * self.places.index(place)
        return slice(first, first + 10)


def roll_index(start: Tensor, num_vertices: Tensor, n: int) -> Tensor:
    """int64 (b, n): the index (start + i) mod num_vertices; beyond the end of a ring any valid index."""
    return (start[:, None] + torch.arange(n, device=start.device)) % num_vertices[:, None].clamp(min=1)


def _inside(num_vertices: Tensor, n: int) -> Tensor:
    return torch.arange(n, device=num_vertices.device) < num_vertices[:, None]
