"""A slow .svoq decoder in plain Python, written from schemas/svoq.md alone. It shares no code with nerfbake."""

from __future__ import annotations

import math
import struct
import zlib
from bisect import bisect_left
from collections import defaultdict
from typing import Any

Row = list[int]
ANCHORS = [22, 36, 60, 98, 162, 267, 439, 720, 1179, 1921, 3108, 4971, 7812, 11955, 17625, 24743, 32768]
ANCHORS += [65536 - value for value in ANCHORS[-2::-1]]
SHARES = [0, 12, 6, 4, 3]
PAIRS = [(2, (0, 1, 2, 3), (4, 5, 6, 7)), (1, (0, 1), (2, 3)), (1, (4, 5), (6, 7))]
PAIRS += [(0, (octant,), (octant + 1,)) for octant in (0, 2, 4, 6)]  # axis, lower half, upper half


def squash(x: int) -> int:
    t = max(x, -2047) + 2048
    return (ANCHORS[t >> 7] * (128 - t % 128) + ANCHORS[(t >> 7) + 1] * (t % 128) + 64) >> 7


SQUASHED = [squash(x) for x in range(-2047, 2048)]
STRETCH = [min(bisect_left(SQUASHED, 16 * q + 8), 4094) - 2047 for q in range(4096)]


def bucket(value: int, steps: tuple[int, ...]) -> int:
    return sum(step <= value for step in steps)


def S(value: int) -> int:
    return bucket(value, (1, 2, 3, 5, 7, 10, 15, 23, 36, 60, 120))


def M(value: int) -> int:
    return bucket(value, (1, 2, 3, 5, 8, 14, 24, 44, 90))


def sign(value: int) -> int:
    return 1 + (value > 0) - (value < 0)


def cut(value: int) -> int:
    return max(-255, min(255, value))


class Stream:
    """The range decoder with its models and weights."""

    def __init__(self, data: bytes) -> None:
        self.data, self.place = data, 4
        self.code = int.from_bytes(data[:4].ljust(4, b"\0"), "big")
        self.range = 2**32 - 1
        self.models: dict[Any, tuple[int, int]] = defaultdict(lambda: (1 << 21, 0))
        self.weights: dict[Any, list[int]] = defaultdict(lambda: [19661] * 4)

    def bit(self, p: int) -> int:
        bound = self.range * p >> 16
        if self.code < bound:
            bit, self.range = 1, bound
        else:
            bit, self.code, self.range = 0, self.code - bound, self.range - bound
        while self.range < 1 << 24:
            self.code = self.code << 8 | (self.data[self.place] if self.place < len(self.data) else 0)
            self.range, self.place = self.range << 8, self.place + 1
        return bit

    def learn(self, model: Any, bit: int) -> None:
        p, n = self.models[model]
        self.models[model] = p + ((4194303 * bit - p) * (131072 // (2 * n + 3)) >> 16), min(n + 1, 250)

    def mixed(self, kind: Any, which: Any, *found_by: Any) -> int:
        models = [(kind, i, key) for i, key in enumerate(found_by)]
        weights = self.weights[kind, which]
        inputs = [STRETCH[self.models[model][0] >> 10] for model in models]
        x = sum(w * each for w, each in zip(weights, inputs, strict=True)) >> 16
        p = squash(max(-2047, min(2047, x)))
        bit = self.bit(p)
        error = 65535 * bit - p
        weights[:] = [w + (each * 3 * error + 32768 >> 16) for w, each in zip(weights, inputs, strict=True)]
        for model in models:
            self.learn(model, bit)
        return bit

    @property
    def whole(self) -> bool:
        return self.place - 3 == len(self.data)


class Tree:
    """The nodes decoded so far, with level, parent, octant, mask and children."""

    def __init__(self, height: int) -> None:
        self.height = height
        self.nodes: list[dict[str, Any]] = [{"level": 0, "parent": None, "octant": 0}]

    def add(self, node: int, mask: int) -> None:
        own = self.nodes[node]
        own["mask"], own["children"] = mask, {}
        for octant in range(8):
            if mask >> octant & 1:
                own["children"][octant] = len(self.nodes)
                self.nodes.append({"level": own["level"] + 1, "parent": node, "octant": octant})

    def beside(self, node: int, axis: int, upper: int) -> int | None:
        """The neighbour on the same level, on the lower or upper side along an axis."""
        own = self.nodes[node]
        if own["parent"] is None:
            return None
        other = own["octant"] ^ 1 << axis
        near = own["parent"] if own["octant"] >> axis & 1 != upper else self.beside(own["parent"], axis, upper)
        children: dict[int, int] = {} if near is None else self.nodes[near]["children"]
        return children.get(other)


def read_masks(stream: Stream, tree: Tree, c: int) -> Row:
    masks: Row = []
    for node in range(c):
        level = min(tree.nodes[node]["level"], 15)
        near = [tree.beside(node, axis, upper) for upper in (0, 1) for axis in range(3)]
        faces = sum(1 << i for i, each in enumerate(near) if each is not None)
        leaves = min(3, sum(each is not None and each < node and masks[each] == 0 for each in near))
        mask = 0
        if not stream.mixed("leaf", 8, (level, leaves), (faces, leaves), level, leaves):
            for o in range(8):
                if o == 7 and mask == 0:
                    mask = 128
                    break
                outside = 0
                for axis in range(3):
                    other, touched = near[axis + 3 * (o >> axis & 1)], o ^ 1 << axis
                    if other is None:
                        state = 0
                    elif other > node:
                        state = 1
                    else:
                        state = 3 if masks[other] == 0 or masks[other] >> touched & 1 else 2
                    outside = 4 * outside + state
                before, known = 1 << o | mask, mask.bit_count()
                found_by = (before, faces), (o, outside, known), (before, outside), (o, level, known)
                mask |= stream.mixed("octant", o, *found_by) << o
        masks.append(mask)
        tree.add(node, mask)
    return masks


def places_of(tree: Tree, c: int) -> list[tuple[int, int]]:
    """The node and slot of each row, from row 1."""
    order: list[tuple[int, int]] = []
    for level in range(tree.height):
        nodes = [node for node in range(c) if tree.nodes[node]["level"] == level]
        for slots in ((0,), (1, 2), (3, 4, 5, 6)):
            for node in nodes:
                for slot in slots:
                    _, lower, upper = PAIRS[slot]
                    children = tree.nodes[node]["children"]
                    if any(o in children for o in lower) and any(o in children for o in upper):
                        order.append((node, slot))
    return order


def pairs_of(tree: Tree, c: int) -> list[tuple[int, int, list[int | None]]]:
    """The slot, axis and four references of each row, from row 1."""
    order = places_of(tree, c)
    rows = {place: row for row, place in enumerate(order, 1)}
    found = []
    for node, slot in order:
        axis, lower, _ = PAIRS[slot]
        references: list[int | None] = []
        for side in range(3):
            start = lower[0]
            if side > axis and start >> side & 1:  # the upper half along this axis: the lower half is in the same node
                other: int | None = node
            else:
                other = tree.beside(node, side, 0)
            if side > axis:
                start ^= 1 << side
            touching = next(s for s, (a, low, _) in enumerate(PAIRS) if a == axis and low[0] == start)
            references.append(None if other is None else rows.get((other, touching)))
        above = node
        reference = None
        while reference is None and tree.nodes[above]["parent"] is not None:
            o, above = tree.nodes[above]["octant"], tree.nodes[above]["parent"]
            reference = rows.get((above, {0: 3 + (o >> 1), 1: 1 + (o >> 2), 2: 0}[axis]))
        found.append((slot, axis, [*references, reference]))
    return found


def read_row(stream: Stream, rows: list[Row], row: int, pair: Any, first: int, last: int) -> None:
    slot, axis, references = pair
    C, values = len(rows[0]), rows[row]
    near = [[0] * C if i is None else [cut(value) for value in rows[i]] for i in references]
    share = SHARES[sum(i is not None for i in references)]
    k = first
    while k < last:
        v1, v2, v3 = (values[k - i] if k >= i else 0 for i in (1, 2, 3))
        recent = S(2 * min(abs(v1), 40) + min(abs(v2), 40) + min(abs(v3), 40))
        total = S(sum(min(abs(value), 20) for value in values[:k]))
        if k >= 9 and (k - 9) % 6 == 0 and k < C - 1:
            g, stop = (k - 9) // 6, min(k + 6, C - 1, last)
            close = S(sum(min(abs(n), 3) for each in near for n in each[k:stop]) * share // 6)
            if not stream.mixed(
                "group", g, (g, recent, total), (g, close, total), (close, recent, total), (g, close, slot)
            ):
                k = stop
                continue
        dots = [sum(cut(values[j]) * each[j] for j in range(k)) for each in near]
        energy = sum(each[j] ** 2 for each in near for j in range(k))
        n = [each[k] for each in near]
        beside, above = abs(n[0]) + abs(n[1]) + abs(n[2]), S(2 * abs(n[3]))
        around = S((beside + abs(n[3])) * share // 3)
        guess = sum(dot * each for dot, each in zip(dots, n, strict=True))
        match = M(8 * abs(guess) // (energy + 1))
        by_size = (k, recent, total), (k, S(2 * beside), above), (around, recent, total)
        if stream.mixed("zero", k, *by_size, (k, match, around)):
            signs, way = tuple(map(sign, n)), 10 + match if guess > 0 else 10 - match
            found_by = (signs, k), (k, sign(v1), sign(v2), way), (way, signs), (k, sign(n[3]), axis, way)
            negative = stream.mixed("sign", k, *found_by)
            fits = 10 if guess == 0 else 10 + match if (guess < 0) == bool(negative) else 10 - match
            size = read_size(stream, k, *by_size, (k, fits, around))
            values[k] = -size if negative else size
        k += 1


def read_size(stream: Stream, k: int, *by_size: Any) -> int:
    s = 1
    while stream.mixed("size", (k, min(s, 16)), *((*each, min(s, 16)) for each in by_size)):
        s += 1
    if s <= 8:
        return s
    value = 1
    for i in range(s - 8):
        if i == 0:
            bit = stream.bit(max(64, min(65472, stream.models[k, s][0] >> 6)))
            stream.learn((k, s), bit)
        else:
            bit = stream.bit(32768)
        value = 2 * value + bit
    return value + 7


def inflated_rows(data: bytes, m: int, C: int) -> list[Row]:
    lengths, rows, place = data[: m - 1], [[0] * C for _ in range(m)], m - 1
    large = []
    for k in range(C):
        for i in range(1, m):
            if k == C - 1 or lengths[i - 1] > k:
                rows[i][k] = data[place]
                place += 1
                if rows[i][k] == 255:
                    large.append((i, k))
    for i, k in large:
        (rows[i][k],) = struct.unpack_from("<I", data, place)
        place += 4
    assert place == len(data)
    return [[-(u + 1) // 2 if u & 1 else u // 2 for u in row] for row in rows]


def leaves_of(told: dict[str, Any]) -> list[list[float]]:
    """The values of each leaf, breadth-first. told: the result of read()."""
    tree, rows, C = Tree((max(told["size"]) - 1).bit_length()), told["values"], len(told["values"][0])
    for node, mask in enumerate(told["masks"]):
        tree.add(node, mask)
    steps = [told["colour_step"]] * (C - 1) + [told["density_step"]]
    parents = [own["parent"] for own in tree.nodes]
    leaves = [int(not own.get("mask")) for own in tree.nodes]
    for node in range(len(parents) - 1, 0, -1):
        leaves[parents[node]] += leaves[node]
    sums = {0: [value * step for value, step in zip(rows[0], steps, strict=True)]}
    where = {(node, slot): row for row, (node, slot) in enumerate(places_of(tree, len(told["masks"])), 1)}
    for node in range(len(told["masks"])):
        children = tree.nodes[node]["children"]
        if not children:
            continue
        parts = {tuple(range(8)): sums[node]}
        for slot, (_, lower, upper) in enumerate(PAIRS):
            both = lower + upper
            whole = parts.pop(both)
            low, high = (sum(leaves[children[o]] for o in half if o in children) for half in (lower, upper))
            parts[lower] = parts[upper] = whole
            if (node, slot) in where:
                p, q = math.sqrt(low / (low + high)), math.sqrt(high / (low + high))
                differences = [value * step for value, step in zip(rows[where[node, slot]], steps, strict=True)]
                parts[lower] = [p * s - q * d for s, d in zip(whole, differences, strict=True)]
                parts[upper] = [q * s + p * d for s, d in zip(whole, differences, strict=True)]
        sums |= {child: parts[octant,] for octant, child in children.items()}
    found = []
    for node, own in enumerate(tree.nodes):
        if not own.get("mask"):
            *colour, v = sums[node]
            mixed = [
                sum(c * (x * told["mixing_scale"]) for c, x in zip(colour, line, strict=True))
                for line in told["mixing"]
            ]
            found.append([*mixed, told["density_scale"] * math.expm1(max(v, 0.0))])
    return found


def read(data: bytes) -> dict[str, Any]:
    """Decode a file completely, to plain Python numbers."""
    magic, version, coding, basis, count, *size, zero, c, m = struct.unpack_from("<4s4B4H2I", data)
    assert (magic, version, zero, zlib.crc32(data[:-4])) == (b"SVOQ", 1, 0, int.from_bytes(data[-4:], "little"))
    numbers = struct.unpack_from("<10d", data, 24)
    start, parts = 104 + 12 * count, []
    for i in range(count):
        kind, end, _, length, unpacked = struct.unpack_from("<BBHII", data, 104 + 12 * i)
        parts.append((kind, end, data[start : start + length], unpacked))
        start += length
    assert start + 4 == len(data)
    B = max(1, basis)
    C = 3 * B + 1
    mixing = struct.unpack(f"<{9 * B * B}h", parts[0][2][: 18 * B * B])
    total = list(struct.unpack(f"<{C}i", parts[0][2][18 * B * B :]))
    tree = Tree((max(size) - 1).bit_length())
    streams = [(end, part, unpacked) for kind, end, part, unpacked in parts if kind == 2]
    if coding:
        masks = list(zlib.decompress(parts[1][2]))
        rows = inflated_rows(zlib.decompress(streams[0][1]), m, C)
    else:
        stream = Stream(parts[1][2])
        masks = read_masks(stream, tree, c)
        assert stream.whole
        rows, pairs, first = [[0] * C for _ in range(m)], pairs_of(tree, c), 0
        for end, part, _ in streams:
            stream = Stream(part)
            for row in range(1, m):
                read_row(stream, rows, row, pairs[row - 1], first, end)
            assert stream.whole
            first = end
    return {
        "size": size,
        "data_format": f"SH{basis}" if basis else "RGBA",
        "origin": list(numbers[:3]),
        "voxel_size": list(numbers[3:6]),
        "colour_step": numbers[6],
        "density_step": numbers[7],
        "density_scale": numbers[8],
        "mixing_scale": numbers[9],
        "mixing": [list(mixing[i : i + 3 * B]) for i in range(0, len(mixing), 3 * B)],
        "masks": masks,
        "values": [total, *rows[1:]],
    }
