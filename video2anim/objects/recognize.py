"""Recognition of an object's form: all forms are fitted from several yaws and ranked by their evidence."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from video2anim.objects.evidence import SeenObject
from video2anim.objects.extrusion import OUTLINE, outline_form
from video2anim.objects.form_fit import FitSigmas, FormFit, FormProblem
from video2anim.objects.furniture import FORMS, Form
from video2anim.objects.upright_box import UprightBox

_SCREEN_SAMPLES, _SAMPLES = 3, 7
"""Surface samples along a side of a solid, while forms are compared (by half of the pixels) and at the end."""
_SCREEN_ROUNDS = 2, 4
"""Of all forms, then of the better half of them (successive halving). Of 36 objects on six clips of V2A-Bench, 35 had
the form that wins among the better half after two rounds; a script that is not kept."""
_PLAIN = ("box", "cabinet", "stack", OUTLINE)
"""Forms that mostly stand on the floor but may stand on something else."""
_RAISED = 0.05
"""Prior probability that one of them stands on something other than the floor."""
_FARTHER = 3.0
"""Standard deviations of its distance by which an object of a second start is farther."""
_KEPT, _ENDS = 4, 2
"""Forms that are fitted at full resolution, and from how many of the ends that their starts have reached."""
_APART = 2.5
"""What rested near an object rested on something else if that explains more than deviations of so many standard
deviations, 1 nat a look: who sits behind a table does not sit on it. Leaving the rests out gains up to 0.8 nats where
somebody rested on the object (9 of V2A-Bench and the real clips), 1.0 to 2.8 where not (3; a script that is not kept).
"""


def recognized(
    seen: SeenObject,
    log_prior: Mapping[str, float],
    forms: Sequence[Form] | None = None,
    sigmas: FitSigmas | None = None,
) -> list[FormFit]:
    """The forms fitted at full resolution, best first.

    Args:
        log_prior: Logarithm of the odds of each class of form before the object was measured; classes that are not
            named are not tried.
        forms: Those that are tried; by default all, and the object's outline with a thickness.
    """
    sigmas = FitSigmas() if sigmas is None else sigmas
    return _refined(_screened(seen, log_prior, forms, sigmas), seen)


class Recognition:
    """An object of which a network has told the class."""

    def __init__(self, seen: SeenObject, label: str) -> None:
        self.seen, self.label = seen, label

    @cached_property
    def screened(self) -> list[Screened]:
        """All forms at low resolution, best first."""
        return _screened(self.seen, log_prior(self.label), None, FitSigmas())

    @cached_property
    def refined(self) -> list[FormFit]:
        """The first of them fitted at full resolution, best first."""
        return _refined(self.screened, self.seen)

    @property
    def log_evidence(self) -> float:
        """Of the best form: after a few rounds it is known to some 10 nats, and which form is best is not."""
        return self.refined[0].log_evidence

    def evidence_over(self, apart: Recognition, place: int) -> float:
        """Gain of log evidence over the same object if what rested at a place rested on something else."""
        rests, looks = self.seen.evidence.rested, FitSigmas().looks
        own = min(looks / len(rests), 1.0) * float((rests.place == place).sum())
        odds = 0.5 * own * float(np.log1p(_APART**2))
        return self.log_evidence - apart.log_evidence + odds

    def fits(self) -> tuple[list[FormFit], str]:
        """`refined`, and the object's label: the best form's class where its own names none, or another class."""
        fits, meant = self.refined, _meant(self.label)
        kept = self.label not in _UNNAMED if meant is None else fits[0].form.name in meant
        return fits, self.label if kept else fits[0].form.name


def rested_on_one(seen: Mapping[int, SeenObject], labels: Mapping[int, str]) -> dict[int, Recognition]:
    """The objects, with each place where people rested near them left to one: that whose evidence it lowers least, or
    none if it is more likely that they rested on something else. The places with the most points come first.

    Args:
        seen: By object number.
        labels: Class of each that a network has named.
    """
    points = {number: Counter(one.evidence.rested.place.tolist()) for number, one in seen.items()}
    owned: dict[int, list[int]] = {number: [] for number in seen}
    found = {number: Recognition(one.rested_at(()), labels[number]) for number, one in seen.items()}
    total = sum(points.values(), Counter())
    for place in sorted(total, key=lambda place: -total[place]):
        tried = {
            number: Recognition(seen[number].rested_at([*owned[number], place]), labels[number])
            for number in seen
            if place in points[number]
        }
        gains = {number: one.evidence_over(found[number], place) for number, one in tried.items()}
        best = max(gains, key=gains.__getitem__)
        if gains[best] > 0:
            owned[best].append(place)
            found[best] = tried[best]
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Screened:
    """A form after a few rounds at low resolution."""

    problem: FormProblem
    base_m: float
    log_prior: float
    score: float
    """Log evidence of the best end."""
    ends: Float[np.ndarray, "ends values"]

    def continued(self) -> Screened:
        """The same after the other rounds."""
        ends = self.problem.fitted(self.ends, _SCREEN_ROUNDS[1])
        scores = self.problem.laplace(ends)[0] + self.log_prior
        return replace(self, score=float(scores.max()), ends=ends[np.argsort(-scores)[:_ENDS]])


def _refined(screened: Sequence[Screened], seen: SeenObject) -> list[FormFit]:
    """The first of them at full resolution, best first."""
    fits = []
    for one in screened[:_KEPT]:
        problem = FormProblem(one.problem.form, seen.evidence, one.base_m, one.problem.sigmas, _SAMPLES)
        fits.append(problem.result(one.ends, one.log_prior))
    return sorted(fits, key=lambda fit: -fit.log_evidence)


def _screened(
    seen: SeenObject, log_prior: Mapping[str, float], forms: Sequence[Form] | None, sigmas: FitSigmas
) -> list[Screened]:
    """All forms at low resolution, best first."""
    evidence, box, relief = seen.evidence, seen.box(), seen.evidence.depth_errors.relief
    boxes = [(box, 0.0)]
    if box.holds(evidence.body_m).any():
        # Also from behind the people who were there.
        farther = _FARTHER * evidence.distance_sigma
        boxes.append((seen.box(farther), farther))
    if len(evidence.rested):
        # Also as far away as what rested on it, where that is elsewhere.
        rest_m, seen_m = (
            np.median(np.linalg.norm(some_m - evidence.camera_m, axis=1))
            for some_m in (evidence.rested.point_m, seen.points_m)
        )
        if abs(nearer := float(np.log(rest_m / seen_m))) > evidence.distance_sigma:
            boxes.append((seen.box(nearer), nearer))
    lowest_m = max(float(np.percentile(seen.points_m[:, 1], 2)), 0.0) if evidence.raised else 0.0
    tries = [
        (form, [start for one in boxes for start in _starts(form, *one, 0.0 if form.stands else lowest_m, relief)])
        for form in (FORMS if forms is None else forms)
        if form.name in log_prior
    ]
    if forms is None and OUTLINE in log_prior and (own := outline_form(seen, box, lowest_m, sigmas)) is not None:
        tries.append((own[0], [own[1]]))
    screened, half = [], evidence.every_other()
    for form, starts in tries:
        base_m = 0.0 if form.stands else lowest_m
        problem = FormProblem(form, half, base_m, sigmas, _SCREEN_SAMPLES)
        ends = problem.fitted(np.stack(starts), _SCREEN_ROUNDS[0])
        best = problem.residuals(ends).cost().argmin()
        prior = _prior(form, base_m, log_prior)
        score = float(problem.laplace(ends[best, None])[0][0]) + prior
        screened.append(Screened(problem, base_m, prior, score, ends))
    screened.sort(key=lambda one: -one.score)
    better = screened[: max(len(screened) // 2, _KEPT)]
    return sorted((one.continued() for one in better), key=lambda one: -one.score)


def _prior(form: Form, base_m: float, log_prior: Mapping[str, float]) -> float:
    """Log odds of a form before it is fitted."""
    raised = _RAISED if base_m > 0 and form.name in _PLAIN else 1.0
    return log_prior[form.name] + float(np.log(form.share * raised))


def _starts(
    form: Form, box: UprightBox, distance_log: float, base_m: float, relief: float
) -> list[Float[np.ndarray, "values"]]:
    """Initial values at the box of the object, for every quarter turn in which the form differs.

    Measured sizes start at those of the box, within two standard deviations of the usual size.
    """
    yaw = float(np.arctan2(box.R_world_box[0, 2], box.R_world_box[2, 2]))
    extent_m = np.array([box.size_m[0], box.high_m[1] - base_m, box.size_m[2]])
    made = []
    for turn in range(form.turns):
        axis_of = {"width": 2 * (turn % 2), "depth": 2 - 2 * (turn % 2), "height": 1}
        logs = []
        for size in form.sizes:
            log, axis = float(np.log(size.usual_m)), axis_of.get(size.name)
            if axis is not None and box.measured[axis]:
                seen = float(np.log(max(extent_m[axis], 0.03)))
                log = float(np.clip(seen, log - 2 * size.spread, log + 2 * size.spread))
            logs.append(log)
        sizes = dict(zip((size.name for size in form.sizes), np.exp(logs), strict=True))
        center = box.center_m.copy()
        center[2] = box.high_m[2] - 0.5 * sizes.get("depth" if turn % 2 == 0 else "width", sizes["width"])
        x, _, z = box.R_world_box @ center
        made.append(np.array([x, z, yaw + turn * np.pi / 2, base_m, distance_log, relief - 1, *logs]))
    return made


_SYNONYMS = {
    "couch": "sofa", "dining table": "table", "coffee table": "table", "potted plant": "plant", "bookcase": "shelf",
    "wardrobe": "cabinet", "chest of drawers": "cabinet", "cupboard": "cabinet", "refrigerator": "cabinet",
    "ottoman": "stool", "bench": "table", "stairs": "steps", "step": "steps", "swivel chair": "chair",
}  # fmt: skip
"""Labels of segmentation networks -> classes of forms."""
_BROAD = {
    "chair": {"armchair": 0.3, "stool": 0.1, "sofa": 0.05}, "table": {"desk": 0.5}, "desk": {"table": 0.5},
    "box": {"stool": 0.2},
}  # fmt: skip
"""Other classes that a label may mean, with their odds against the class itself."""


_CLASSES = tuple(sorted({form.name for form in FORMS} | {OUTLINE}))
_UNNAMED = ("object", "furniture")
"""Labels of segmentation that name no class."""
_MISLABELED = 0.05
"""Share of objects that a network gives the label of another class: a judgment. All classes share it."""


def log_prior(label: str) -> dict[str, float]:
    """Log odds of the classes of forms for an object that a network has labeled, against the class of that name.

    Labels without a form give equal odds for all classes.
    """
    if (meant := _meant(label)) is None:
        return dict.fromkeys(_CLASSES, 0.0)
    other = float(np.log(_MISLABELED / len(_CLASSES)))
    return dict.fromkeys(_CLASSES, other) | {name: float(np.log(odds)) for name, odds in meant.items()}


def _meant(label: str) -> dict[str, float] | None:
    """Odds of the classes that a label may mean; None if no form has that name."""
    name = _SYNONYMS.get(label, label)
    return {name: 1.0, **_BROAD.get(name, {})} if name in _CLASSES else None
