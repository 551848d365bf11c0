"""How the head differs between people and how it moves: identity modes, expressions, lips and lids that close."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from tools.head_mesh import LID_RINGS, LIP_RINGS, Mesh, Rings
from tools.head_source import Source
from tracker.modes import LIP_SHAPES

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Rows = dict[int, list[int]]

# The mesh's eyes stand 58 mm apart on average; people's this far, m.
EYE_DISTANCE = 0.0624
SLIDERS = ("asym", "cheek", "chin", "ears", "eyebrows", "eyes", "forehead", "head", "mouth", "neck", "nose")
OPPOSITE = {
    "decr": "incr", "down": "up", "in": "out", "backward": "forward", "concave": "convex",
    "compress": "uncompress", "l": "r",
}  # fmt: skip
SLIDER_SD = 0.25
ASYMMETRY_SD = 0.15
RACES = ("african", "asian", "caucasian")

# How much of a closing motion the rings next to the contact follow.
FOLLOW = {0: 1.0, 1: 0.7, 2: 0.4, 3: 0.15, -1: 0.75, -2: 0.45, -3: 0.2}
LID_FOLLOW = {0: 1.0, 1: 0.8, 2: 0.5, 3: 0.2, -1: 1.0, -2: 1.0}
# Expressions during which the lips stay as closed as they are without them.
SEALED = (
    "mouthSmileLeft", "mouthSmileRight", "mouthPucker", "mouthFrownLeft", "mouthFrownRight", "mouthDimpleLeft",
    "mouthDimpleRight", "mouthStretchLeft", "mouthStretchRight", "mouthPressLeft", "mouthPressRight", "mouthLeft",
    "mouthRight", "cheekPuff",
)  # fmt: skip

# The lips' own shapes: displacement at weight 1, and how far from the lips' edges the skin follows, m.
LIP_SHAPE, LIP_REACH = 0.005, 0.008


def mirrored(field: F64, mesh: Mesh) -> F64:
    """The mirror image of positions or displacements [.., D, 3]."""
    return field[..., mesh.mirror, :] * np.array([-1.0, 1.0, 1.0])


# --- people ---------------------------------------------------------------------------------------------------


def sample_people(source: Source, mesh: Mesh, count: int, seed: int) -> F64:
    """[count, D + 3, 3] m of random adults; rigid place as the source gives it."""
    rng = np.random.default_rng(seed)
    people = np.repeat(mesh.of(source.vertices)[None], count, axis=0)
    for names, sd in _signed_sliders(source):
        amounts = np.clip(rng.normal(0, sd, count), -1, 1)
        for sign, group in zip((1, -1), names):
            displacement = sum((mesh.of(source.slider(name)) for name in group), np.zeros_like(people[0]))
            people += np.maximum(sign * amounts, 0)[:, None, None] * displacement
    race = rng.dirichlet([0.5] * 3, count)
    gender, age = rng.uniform(0, 1, count), rng.uniform(0, 0.5, count)
    muscle, weight = rng.uniform(0.1, 0.9, count), rng.uniform(0.1, 0.9, count)
    by_gender = {"female": 1 - gender, "male": gender}
    by_age = {"young": 1 - age, "old": age}
    for sex, of_sex in by_gender.items():
        for years, of_age in by_age.items():
            for k, name in enumerate(RACES):
                target = mesh.of(source.slider(f"macrodetails/{name}-{sex}-{years}"))
                people += (race[:, k] * of_sex * of_age)[:, None, None] * target
            for strength, of_muscle in _levels(muscle).items():
                for mass, of_weight in _levels(weight).items():
                    name = f"macrodetails/universal-{sex}-{years}-{strength}muscle-{mass}weight"
                    people += (of_sex * of_age * of_muscle * of_weight)[:, None, None] * mesh.of(
                        source.slider(name)
                    )
    return people


def _levels(value: F64) -> dict[str, F64]:
    """Weights of the targets at 0, 1/2 and 1 for values between."""
    side = 2 * value - 1
    return {"min": np.maximum(-side, 0), "average": 1 - np.abs(side), "max": np.maximum(side, 0)}


def _signed_sliders(source: Source) -> list[tuple[tuple[list[str], list[str]], float]]:
    """Pairs (sliders at +, sliders at -), left and right moving together, with their standard deviation."""
    names = [n for n in source.slider_names(SLIDERS) if not n.startswith(("asym/asymm", "neck/measure"))]
    pairs, used = [], set()
    for name in names:
        group, _, slider = name.partition("/")
        if name in used or slider.startswith("r-"):
            continue
        stem, _, ending = slider.rpartition("-")
        opposite = f"{group}/{stem}-{OPPOSITE.get(ending, ending)}"
        sides = [[name], [opposite] if opposite != name and opposite in names else []]
        used.update(sides[0] + sides[1])
        if slider.startswith("l-"):
            sides = [side + [n.replace("/l-", "/r-") for n in side] for side in sides]
        pairs.append(((sides[0], sides[1]), ASYMMETRY_SD if group == "asym" else SLIDER_SD))
    return pairs


def align(people: F64, anchors: I64) -> F64:
    """Move each head rigidly so that its anchors (the upper face) lie best on their mean."""
    reference = people[:, anchors].mean(0)
    aligned = np.empty_like(people)
    for _ in range(2):
        centre = reference.mean(0)
        for k, head in enumerate(people):
            middle = head[anchors].mean(0)
            left, _, right = np.linalg.svd((head[anchors] - middle).T @ (reference - centre))
            handed = np.diag([1, 1, np.sign(np.linalg.det(left @ right))])
            aligned[k] = (head - middle) @ (left @ handed @ right) + centre
        reference = aligned[:, anchors].mean(0)
    return aligned


def identity_modes(people: F64, mesh: Mesh, weight: F64, count: int) -> tuple[F64, F64, float]:
    """Mean [D + 3, 3], modes [count, D + 3, 3] m per standard deviation, and the share of the variance they hold.

    People and their mirror images are one population, so each mode is symmetric or antisymmetric; both kinds are
    solved apart, which keeps equal eigenvalues from mixing them. weight: [D] of each vertex in the variance.
    """
    turned = _mirrored_with_joints(people, mesh)
    mean = (people + turned).mean(0) / 2
    modes, energies, total = [], [], 0.0
    root = np.sqrt(np.r_[weight, 0, 0, 0])[:, None]
    for part in ((people + turned) / 2 - mean, (people - turned) / 2):
        flat = (part * root).reshape(len(part), -1)
        energy, scores = np.linalg.eigh(flat @ flat.T / len(part))
        top = slice(None, -count - 1, -1)
        modes.append(np.tensordot(scores[:, top].T, part, axes=1) / np.sqrt(len(part)))
        energies.append(energy[top])
        total += energy.sum()
    order = np.argsort(-np.concatenate(energies), kind="stable")[:count]
    chosen = np.concatenate(modes)[order]
    return mean, chosen * _signs(chosen, mean), float(np.concatenate(energies)[order].sum() / total)


def _mirrored_with_joints(people: F64, mesh: Mesh) -> F64:
    order = np.r_[mesh.mirror, mesh.count, mesh.count + 2, mesh.count + 1]
    return people[:, order] * np.array([-1.0, 1.0, 1.0])


def _signs(modes: F64, mean: F64) -> F64:
    """+1 or -1 per mode so that its largest entry on the left half is positive: two builds agree."""
    left = (modes * (mean[:, :1] > 1e-4)).reshape(len(modes), -1)
    largest = np.take_along_axis(left, np.abs(left).argmax(1)[:, None], axis=1)
    return np.sign(largest)[:, :, None]


# --- closing --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Seam:
    """Two edges that meet, each from its right to its left corner.

    upper, lower: all vertices of the edges. upper_paired, lower_paired: as many as the coarser edge has, paired.
    closing: [D, D], brings the edges together half way each and takes the rings around along. behind_upper,
    behind_lower: vertices of the rings behind the edges.
    """

    upper: I64
    lower: I64
    upper_paired: I64
    lower_paired: I64
    closing: csr_array
    behind_upper: I64
    behind_lower: I64

    def part_behind(self, vertices: F64) -> F64:
        """Positions [D, 3] of which nothing behind an edge reaches beyond it.

        The source's lips bulge behind the line where they meet: they would hide an opening of up to 1.3 mm.
        """
        parted = vertices.copy()
        for behind, edge, outer, beside in (
            (self.behind_upper, self.upper, np.maximum, -np.inf),
            (self.behind_lower, self.lower, np.minimum, np.inf),
        ):
            (x, y), at = vertices[edge, :2].T, vertices[behind]
            parted[behind, 1] = outer(at[:, 1], np.interp(at[:, 0], x, y, left=beside, right=beside))
        return parted

    def close(self, vertices: F64) -> F64:
        """[.., D, 3] with the seam closed. Linear: it may be given positions or differences of them."""
        flat = np.moveaxis(vertices, -2, 0).reshape(vertices.shape[-2], -1)
        for _ in range(4):
            flat = self.closing @ flat
        return np.moveaxis(flat.reshape(vertices.shape[-2], *vertices.shape[:-2], 3), 0, -2)


def seam(mesh: Mesh, upper: Rows, lower: Rows, follow: dict[int, float], rest: F64) -> Seam:
    """Pair two half rings by their x in `rest` [D, 3]; ring 0 is where they meet."""
    halves = [{k: mesh.base[np.array(v)] for k, v in half.items()} for half in (upper, lower)]
    entries: list[tuple[int, int, float]] = [(vertex, vertex, 1.0) for vertex in range(mesh.count)]
    for own, other in (halves, halves[::-1]):
        for column, vertex in enumerate(own[0][1:-1], start=1):
            partners, shares = _opposite(vertex, other[0], rest)
            for number, amount in follow.items():
                row = own[number][column]
                entries.append((row, vertex, -0.5 * amount))
                entries += [(row, partner, 0.5 * amount * share) for partner, share in zip(partners, shares)]
    row, column, value = np.array(entries).T
    closing = csr_array((value, (row.astype(int), column.astype(int))), (mesh.count, mesh.count))
    edges = halves[0][0], halves[1][0]
    fewer = min(edges, key=len)
    upper_paired, lower_paired = (edge[np.abs(rest[edge, 0] - rest[fewer, :1]).argmin(1)] for edge in edges)
    behind = (np.concatenate([half[number] for number in half if number < 0]) for half in halves)
    return Seam(edges[0], edges[1], upper_paired, lower_paired, closing, *behind)


def _opposite(vertex: int, edge: I64, rest: F64) -> tuple[I64, F64]:
    """Two neighbours on the other edge and their shares, at the same x."""
    x = rest[edge, 0]
    k = int(np.clip(np.searchsorted(np.maximum.accumulate(x), rest[vertex, 0]), 1, len(edge) - 1))
    t = np.clip((rest[vertex, 0] - x[k - 1]) / max(x[k] - x[k - 1], 1e-9), 0, 1)
    return edge[[k - 1, k]], np.array([1 - t, t])


def seams(source: Source, mesh: Mesh, rest: F64) -> dict[str, Seam]:
    """`lips`, `left_lids` and `right_lids`."""
    rings = Rings(source)
    found = {"lips": seam(mesh, *rings.halves(LIP_RINGS, 0), FOLLOW, rest)}
    left = rings.halves(LID_RINGS, 1)
    right = [{k: source.mirror[ring][::-1].tolist() for k, ring in half.items()} for half in left]
    found["left_lids"] = seam(mesh, left[0], left[1], LID_FOLLOW, rest)
    found["right_lids"] = seam(mesh, right[0], right[1], LID_FOLLOW, rest)
    return found


# --- expressions ----------------------------------------------------------------------------------------------


def expressions(source: Source, mesh: Mesh, template: F64, joined: dict[str, Seam]) -> tuple[list[str], F64]:
    """The 52 names and shapes [52, D, 3] m: symmetrized, with lips that stay shut and lids that just meet."""
    names = source.shape_names()
    raw = {name: mesh.of(source.shape(name))[:-3] for name in names}
    for part in ("helper-l-eye", "helper-r-eye"):
        for shape in raw.values():
            shape[mesh.parts[part]] = 0  # eyeballs turn by their joints
    shapes = {name: (raw[name] + mirrored(raw[_other_side(name)], mesh)) / 2 for name in names}
    shapes["jawOpen"] = _lower_tongue(shapes["jawOpen"], template, mesh)
    lips = joined["lips"]
    for name in SEALED:
        shapes[name] = lips.close(shapes[name])
    # mouthClose is what jawOpen needs to close the lips again.
    shapes["mouthClose"] = lips.close(shapes["mouthClose"] + shapes["jawOpen"]) - shapes["jawOpen"]
    shapes["eyeBlinkLeft"] = _blink(shapes["eyeBlinkLeft"], template, mesh, joined["left_lids"])
    shapes["eyeBlinkRight"] = mirrored(shapes["eyeBlinkLeft"], mesh)
    return names, np.stack([shapes[name] for name in names])


def _other_side(name: str) -> str:
    if name.endswith("Left"):
        return name.removesuffix("Left") + "Right"
    return name.removesuffix("Right") + "Left" if name.endswith("Right") else name


def _lower_tongue(jaw_open: F64, template: F64, mesh: Mesh) -> F64:
    """Flatten the tongue with the open jaw: the source's hides the upper teeth and the throat."""
    tongue = mesh.parts["helper-tongue"]
    lowered = jaw_open.copy()
    lowered[tongue, 1] -= 0.7 * (template[tongue, 1] - template[tongue, 1].min())
    return lowered


def _blink(blink: F64, template: F64, mesh: Mesh, lids: Seam) -> F64:
    """A blink at weight 1 whose lids meet: the source's pass each other by up to 5 mm and leave the corner open."""
    up, down = lids.upper_paired[1:-1], lids.lower_paired[1:-1]
    gap, motion = (template[up] - template[down])[:, 1], (blink[up] - blink[down])[:, 1]
    scale = np.median(np.clip(-gap / motion, 0, 1))
    closed = lids.close(template + scale * blink)
    ball = mesh.parts["helper-l-eye"]
    centre = template[ball[0]] - [0, 0, np.ptp(template[ball, 1]) / 2]
    radius = np.linalg.norm(template[ball] - centre, axis=1).max()
    near = np.unique(lids.closing.nonzero()[0][lids.closing.nonzero()[0] != lids.closing.nonzero()[1]])
    offset = closed[near] - centre
    distance = np.linalg.norm(offset, axis=1, keepdims=True)
    closed[near] = centre + offset * np.maximum(distance, radius + 4e-4) / distance
    return closed - template


def lip_profiles(mesh: Mesh, template: F64, lips: Seam) -> tuple[list[str], F64]:
    """Names and shapes [4, D, 3] m: each lip up by a whole wave, and by one and a half, from corner to corner.

    ARKit's shapes open every mouth with one profile. Half a wave is what they do: it would take their place.
    """
    sides = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    length = np.linalg.norm(template[sides[:, 0]] - template[sides[:, 1]], axis=1)
    graph = csr_array((length, sides.T), (mesh.count, mesh.count))
    edges = lips.upper[1:-1], lips.lower[1:-1]
    far = np.stack([dijkstra(graph, directed=False, indices=edge, min_only=True) for edge in edges])
    right, left = template[lips.upper[[0, -1]], 0]
    along = np.clip((template[:, 0] - right) / (left - right), 0, 1)
    waves = np.stack([np.sin(count * np.pi * along) for count in (2, 3)])
    follow = np.exp(-((far / LIP_REACH) ** 2)) * (far < far[::-1])
    shapes = np.zeros((len(LIP_SHAPES), mesh.count, 3))
    shapes[..., 1] = LIP_SHAPE * (follow[:, None] * waves).reshape(len(LIP_SHAPES), -1)
    return list(LIP_SHAPES), shapes
