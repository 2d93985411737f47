"""What moves a calibrated mount in time: slow drift, steps, and measurements that contradict all others.

Around a guess of the parameters residuals are linear, ``y = J x + Jz (drift + jitter + steps) + foreign + noise``, with
everything Gaussian: the parameters x by the field's prior; two drives' zeros that drift (Ornstein and Uhlenbeck, over
years) and jitter (over hours); a step of one zero or both from one measurement on; a spot that has nothing to do with
the light, all over the place. So each question has an answer in closed form, the odds that data give: is there a step
before this measurement, or is this one alone foreign? The likeliest is believed, then the next, as long as odds are for
one; what later ones make needless is dropped (Savage and Dickey's ratio). Each belief raises the posterior, so it ends.

Sources: Rasmussen and Williams 2006, *Gaussian Processes for Machine Learning*, ch. 2; Dickey 1971,
doi:10.1214/aoms/1177693507.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.pointing.kinematics import ZEROS, Readings

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Noise:
    """Spreads of what is not a parameter, and odds.

    The spreads are those of greatest evidence on half of the heliostats that `tests.benchmarks.pointing` looks at. The
    second drive's jitter is what photographs of one hour have beside the grain of their spots: wind and backlash.

    Attributes
    ----------
    spot_rad : float [rad]
        Of a measured spot, per direction.
    drift_rad, jitter_rad : pair of float [rad]
        Of the drives' zeros.
    drift_days, jitter_days : float [d]
        Over which they forget where they were.
    step_rad, foreign_rad : pair of float [rad]
        How far a step moves a zero, and a foreign spot lies away: the common ones, and the rare large ones.
    step_odds, foreign_odds : float
        Of a step before a measurement, and of a foreign spot in it, before its spot is seen.
    """

    spot_rad: float = 0.27e-3
    drift_rad: tuple[float, float] = (0.5e-3, 1.0e-3)
    drift_days: float = 300.0
    jitter_rad: tuple[float, float] = (0.05e-3, 0.45e-3)
    jitter_days: float = 0.06
    step_rad: tuple[float, float] = (5e-3, 60e-3)
    foreign_rad: tuple[float, float] = (10e-3, 0.3)
    step_odds: float = 2e-2
    foreign_odds: float = 1e-2

    def drift(self, apart_days: Array) -> Array:
        """Covariance (2, ...) [rad2] of a drift with itself, days apart."""
        return np.multiply.outer(np.square(self.drift_rad), np.exp(-apart_days / self.drift_days))

    def jitter(self, apart_days: Array) -> Array:
        """Covariance (2, ...) [rad2] of a jitter with itself, days apart."""
        return np.multiply.outer(np.square(self.jitter_rad), np.exp(-apart_days / self.jitter_days))


@dataclass(frozen=True, eq=False)
class Believed:
    """The posterior of H heliostats, whose readings are in order of time.

    Attributes
    ----------
    parameters : (H, P)
        Means.
    covariance : (H, P, P)
        Of the parameters at the newest measurement, its drift and steps in their zeros.
    drift, jitter, steps : (H, M, 2) [rad]
        What is added to the zeros at each measurement: means, ``steps`` all up to then.
    drifted_std : (H, 2) [rad]
        Of the drift from the first measurement to the newest.
    steps_std : (H, M, 2) [rad]
        Of the step that begins at a measurement; 0 where none does.
    stepped, foreign : (H, M) of bool
        Where a step begins, and measurements that were left out.
    evidence : (H,)
        Logarithm of the probability of the data, and of these beliefs, less a constant.
    spread : (H, P)
        Posterior standard deviations of the parameters alone.
    """

    parameters: Array
    covariance: Array
    drift: Array
    jitter: Array
    steps: Array
    drifted_std: Array
    steps_std: Array
    stepped: Mask
    foreign: Mask
    evidence: Array
    spread: Array

    @property
    def zeros(self) -> Array:
        """What is added to the zeros at each measurement (H, M, 2) [rad]."""
        return self.drift + self.jitter + self.steps


def believe(
    y: Array, jacobian: Array, readings: Readings, prior_mean: Array, prior_cov: Array, noise: Noise
) -> Believed:
    """The posterior of linear residuals ``y`` (H, M, 2) [rad] with derivatives ``jacobian`` (H, M, 2, P).

    ``y`` is what x and zeros shall explain, counted from zero: both are 0 where readings are padded. ``prior_mean``
    (P,) and ``prior_cov`` (P, P) are the field's.
    """
    problem = _Problem.of(y, jacobian, readings, prior_mean, prior_cov, noise)
    terms = _Terms.none(*readings.used.shape)
    active = np.arange(len(y))
    while len(active):
        part, chosen = problem.rows(active), terms.rows(active)
        grew = chosen.grow(part)
        chosen.shed(part)
        terms.write(active, chosen)
        active = active[grew]
    return problem.posterior(terms)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Gaussian data without steps and foreign spots; N = 2 M.

    ``y`` (H, N); ``by_parameter`` (H, N, P); ``by_zero`` (H, M, 2, 2), the last the drive; ``precision`` (H, N, N), the
    inverse covariance of ``y``; ``log_det`` (H,) of that covariance.
    """

    y: Array
    by_parameter: Array
    by_zero: Array
    precision: Array
    log_det: Array
    readings: Readings
    prior_mean: Array
    prior_cov: Array
    noise: Noise

    @classmethod
    def of(cls, y: Array, jacobian: Array, readings: Readings, mean: Array, cov: Array, noise: Noise) -> "_Problem":
        heliostats, most, _, count = jacobian.shape
        by_parameter = jacobian.reshape(heliostats, 2 * most, count)
        by_zero = jacobian[..., ZEROS]
        covariance = by_parameter @ cov @ by_parameter.swapaxes(1, 2)
        apart = np.abs(readings.days[:, :, None] - readings.days[:, None])
        moving = noise.drift(apart) + noise.jitter(apart)
        for drive in (0, 1):
            along = by_zero[..., drive]
            covariance += np.einsum("hia,hij,hjb->hiajb", along, moving[drive], along, optimize=True).reshape(
                covariance.shape
            )
        # One where nothing is used: it adds nothing to the evidence.
        diagonal = np.arange(2 * most)
        covariance[:, diagonal, diagonal] += np.repeat(np.where(readings.used, noise.spot_rad**2, 1.0), 2, axis=1)
        target = y.reshape(heliostats, -1) - by_parameter @ mean
        log_det = np.linalg.slogdet(covariance)[1]
        return cls(
            target, by_parameter, by_zero, np.asarray(np.linalg.inv(covariance)), log_det, readings, mean, cov, noise
        )

    def rows(self, rows: NDArray[np.intp]) -> "_Problem":
        """That of some heliostats."""
        if len(rows) == len(self.y):
            return self
        return replace(
            self,
            y=self.y[rows],
            by_parameter=self.by_parameter[rows],
            by_zero=self.by_zero[rows],
            precision=self.precision[rows],
            log_det=self.log_det[rows],
            readings=Readings(**{name: value[rows] for name, value in vars(self.readings).items()}),
        )

    def posterior(self, terms: "_Terms") -> Believed:
        heliostats, most = self.readings.used.shape
        noise, days = self.noise, self.readings.days
        solved = terms.solve(self)
        explained = solved.precision_y
        pulled = np.einsum("hmka,hmk->hma", self.by_zero, explained.reshape(heliostats, most, 2))
        apart = np.abs(days[:, :, None] - days[:, None])
        drift = np.einsum("khij,hjk->hik", noise.drift(apart), pulled)
        jitter = np.einsum("khij,hjk->hik", noise.jitter(apart), pulled)
        begun, steps_std = terms.begun(solved)
        last = np.maximum(self.readings.used.sum(axis=1) - 1, 0)
        newest = days[np.arange(heliostats), last]
        precision = solved.precision(self)
        covariance, spread = self._spread(terms, precision, newest)
        used = self.readings.used[..., None]
        return Believed(
            parameters=self.prior_mean + (explained[:, None] @ self.by_parameter)[:, 0] @ self.prior_cov,
            covariance=covariance,
            drift=drift * used,
            jitter=jitter * used,
            steps=begun.cumsum(axis=1) * used,
            drifted_std=self._drifted_std(precision, newest),
            steps_std=steps_std,
            stepped=terms.mask(*_STEPS),
            foreign=terms.mask(*_FOREIGN),
            evidence=solved.evidence - 0.5 * self.log_det,
            spread=spread,
        )

    def _drift_at(self, day: Array) -> Array:
        """Covariances (H, 2, N) of the drift at a ``day`` (H,) with the data."""
        heliostats, most = self.readings.used.shape
        shared = self.noise.drift(np.abs(self.readings.days - day[:, None]))
        return np.asarray(np.einsum("hmka,ahm->hamk", self.by_zero, shared).reshape(heliostats, 2, 2 * most))

    def _drifted_std(self, precision: Array, newest: Array) -> Array:
        first = self.readings.days[:, 0]
        cross = self._drift_at(newest) - self._drift_at(first)
        told = np.diagonal(cross @ precision @ cross.swapaxes(1, 2), axis1=1, axis2=2)
        free = 2 * (self.noise.drift(np.zeros(1)) - self.noise.drift(newest - first)).T
        return np.sqrt(np.maximum(free - told, 0))

    def _spread(self, terms: "_Terms", precision: Array, newest: Array) -> tuple[Array, Array]:
        """Covariances (H, P, P) of the state at the days ``newest`` (H,), and spreads (H, P) of the parameters."""
        cross = np.swapaxes(self.by_parameter @ self.prior_cov, 1, 2)
        own = self.prior_cov - cross @ precision @ cross.swapaxes(1, 2)
        at_zero = self._drift_at(newest)
        stepped = terms.stepped_variance(self.noise)  # what each measurement shares with the newest
        at_zero += np.einsum("hmka,hma->hamk", self.by_zero, stepped).reshape(at_zero.shape)
        cross[:, ZEROS] += at_zero
        prior = np.tile(self.prior_cov, (len(newest), 1, 1))
        zeros = np.arange(ZEROS.start, ZEROS.stop)
        prior[:, zeros, zeros] += np.square(self.noise.drift_rad) + stepped[:, -1]
        newest_cov = prior - cross @ precision @ cross.swapaxes(1, 2)
        variances = np.diagonal(own, axis1=1, axis2=2)
        return newest_cov, np.sqrt(np.maximum(variances, 0))


@dataclass(frozen=True, eq=False)
class Posterior:
    """Data with the steps and foreign spots that are believed in them, of any size: what else is asked of them."""

    problem: _Problem
    terms: "_Terms"

    @classmethod
    def of(
        cls, y: Array, jacobian: Array, readings: Readings, mean: Array, cov: Array, noise: Noise, believed: Believed
    ) -> "Posterior":
        """As `believe`, of heliostats that ``believed`` is of; it may be padded further."""
        most = readings.used.shape[1]
        terms = _Terms.marked(believed.stepped[:, :most], believed.foreign[:, :most])
        return cls(_Problem.of(y, jacobian, readings, mean, cov, noise), terms)

    def left_out(self) -> Array:
        """What each measurement (H, M, 2) [rad] lies off what all others of its heliostat foretell.

        NaN where one is foreign, or there is none. Source: Rasmussen and Williams 2006, eq. 5.12.
        """
        heliostats, most = self.problem.readings.used.shape
        solved = self.terms.solve(self.problem)
        blocks = solved.precision(self.problem).reshape(heliostats, most, 2, most, 2)
        own = np.einsum("hiaib->hiab", blocks)
        off = np.linalg.solve(own, solved.precision_y.reshape(heliostats, most, 2, 1))[..., 0]
        told = self.problem.readings.used & ~self.terms.mask(*_FOREIGN)
        return np.where(told[..., None], off, np.nan)

    def told_of_a_change(self, by_change: Array) -> tuple[Array, Array]:
        """What data tell of a number that is 0 up to a measurement and one value from it on, for each measurement.

        ``by_change`` (H, M, 2) are the residuals' derivatives by it. Gives its pull (H, M) and information (H, M): the
        number is likeliest ``pull / information``, with variance ``1 / information``. Steps within one measurement are
        not believed for this question: they would be the change itself by another name.
        """
        problem, terms = self.problem, self.terms
        change = (by_change * problem.readings.used[..., None])[..., None]
        pull, information = _of_change(problem, terms, change)
        is_step = np.isin(terms.kind, _STEPS)
        for term in range(terms.kind.shape[1]):
            place = terms.place[:, term, None]
            beside = is_step & (np.abs(terms.place - place) <= 1)
            without = replace(terms, kind=np.where(beside, 0, terms.kind).astype(np.int8))
            near = is_step[:, term, None] & (np.abs(np.arange(terms.most) - place) <= 1)
            rows = np.nonzero(near.any(axis=1))[0]
            other = _of_change(problem.rows(rows), without.rows(rows), change[rows])
            for old, new in zip((pull, information), other, strict=True):
                old[rows] = np.where(near[rows], new, old[rows])
        return pull, information


def _of_change(problem: _Problem, terms: "_Terms", change: Array) -> tuple[Array, Array]:
    heliostats, most = problem.readings.used.shape
    solved = terms.solve(problem)
    pull = np.einsum("hmka,hmk->hm", change, solved.precision_y.reshape(heliostats, most, 2))
    blocks = solved.precision(problem).reshape(heliostats, most, 2, most, 2)
    return _from_here(pull, 1), _of_pairs(change, blocks)[..., 0, 0]


# Kinds of terms beside none, 0: steps of both drives, the first, the second, common ones and large ones; foreign spots.
_STEPS, _FOREIGN = (1, 2, 3, 4, 5, 6), (7, 8)
_LARGE = 4  # of both drives

# A drive that did not step moved by no more than this share of what one that did.
_STILL = 1e-3


@dataclass(frozen=True, eq=False)
class _Solved:
    """Beliefs weighed against data.

    ``weighed`` (H, N, 2 T) is the precision times what the terms' sizes move; ``cov`` (H, 2 T, 2 T) of those sizes, and
    their means ``sizes`` (H, 2 T); ``precision_y`` (H, N); ``evidence`` (H,).
    """

    weighed: Array
    cov: Array
    sizes: Array
    precision_y: Array
    evidence: Array

    def precision(self, problem: _Problem) -> Array:
        """Inverse covariance (H, N, N) of ``y`` with these beliefs."""
        if not self.cov.shape[-1]:
            return problem.precision
        return problem.precision - self.weighed @ self.cov @ self.weighed.swapaxes(1, 2)


@dataclass(eq=False)
class _Terms:
    """What is believed of each heliostat: up to T steps and foreign spots.

    ``kind`` (H, T) of them; ``place`` (H, T): the measurement.
    """

    kind: NDArray[np.int8]
    place: NDArray[np.intp]
    most: int

    @classmethod
    def none(cls, heliostats: int, most: int) -> "_Terms":
        return cls(np.zeros((heliostats, 0), np.int8), np.zeros((heliostats, 0), np.intp), most)

    @classmethod
    def marked(cls, stepped: Mask, foreign: Mask) -> "_Terms":
        """Terms of the largest kinds where steps and foreign spots are believed (H, M)."""
        kinds = np.concatenate([stepped * _LARGE, foreign * _FOREIGN[-1]], axis=1).astype(np.int8)
        count = int((kinds > 0).sum(axis=1).max(initial=0))
        first = np.argsort(kinds == 0, axis=1, kind="stable")[:, :count]
        most = stepped.shape[1]
        return cls(np.take_along_axis(kinds, first, axis=1), first % most, most)

    def rows(self, rows: NDArray[np.intp]) -> "_Terms":
        return _Terms(self.kind[rows], self.place[rows], self.most)

    def write(self, rows: NDArray[np.intp], other: "_Terms") -> None:
        more = other.kind.shape[1] - self.kind.shape[1]
        if more > 0:
            self.kind = np.pad(self.kind, ((0, 0), (0, more)))
            self.place = np.pad(self.place, ((0, 0), (0, more)))
        self.kind[rows], self.place[rows] = 0, 0
        self.kind[rows, : other.kind.shape[1]] = other.kind
        self.place[rows, : other.kind.shape[1]] = other.place

    def mask(self, *kinds: int) -> Mask:
        """Measurements (H, M) that have a term of one of ``kinds``."""
        mask = np.zeros((len(self.kind), self.most), dtype=bool)
        rows, terms = np.nonzero(np.isin(self.kind, kinds))
        mask[rows, self.place[rows, terms]] = True
        return mask

    def stepped_variance(self, noise: Noise) -> Array:
        """Prior variances (H, M, 2) [rad2] of all steps up to each measurement."""
        begun = np.zeros((len(self.kind), self.most, 2))
        rows, terms = np.nonzero(np.isin(self.kind, _STEPS))
        begun[rows, self.place[rows, terms]] = _variances(noise)[self.kind[rows, terms]]
        return begun.cumsum(axis=1)

    def solve(self, problem: _Problem) -> _Solved:
        heliostats, count = self.kind.shape
        after = np.arange(self.most) >= self.place[..., None]
        alone = np.arange(self.most) == self.place[..., None]
        is_step, is_foreign = (np.isin(self.kind, kinds) for kinds in (_STEPS, _FOREIGN))
        from_here, here = (
            (places & kinds[..., None]).swapaxes(1, 2)[:, :, None, :, None]
            for places, kinds in ((after, is_step), (alone, is_foreign))
        )
        design = from_here * problem.by_zero[:, :, :, None] + here * np.eye(2)[:, None]
        design = design.reshape(heliostats, 2 * self.most, 2 * count)
        variance = _variances(problem.noise)[self.kind].reshape(heliostats, 2 * count)
        weighed = problem.precision @ design
        inverse = design.swapaxes(1, 2) @ weighed
        diagonal = np.arange(2 * count)
        inverse[:, diagonal, diagonal] += 1 / variance
        cov = np.linalg.inv(inverse)
        alpha = (problem.precision @ problem.y[..., None])[..., 0]
        pull = (weighed.swapaxes(1, 2) @ problem.y[..., None])[..., 0]
        sizes = (cov @ pull[..., None])[..., 0]
        odds = np.log(_odds(problem.noise))[self.kind].sum(axis=1)
        evidence = odds + 0.5 * (
            (pull * sizes).sum(axis=1)
            - (alpha * problem.y).sum(axis=1)
            - np.linalg.slogdet(inverse)[1]
            - np.log(variance).sum(axis=1)
        )
        precision_y = alpha - (weighed @ sizes[..., None])[..., 0]
        return _Solved(weighed, cov, sizes, precision_y, evidence)

    def grow(self, problem: _Problem) -> Mask:
        """Believe in what has the best odds, of each heliostat (H,) where any has good ones."""
        solved = self.solve(problem)
        gains = self._gains(problem, solved)
        best = gains.reshape(len(gains), -1).argmax(axis=1)
        kinds, places = np.divmod(best, self.most)
        good = gains[np.arange(len(gains)), kinds, places] > 0
        self.kind = np.column_stack([self.kind, np.where(good, kinds + 1, 0)]).astype(np.int8)
        self.place = np.column_stack([self.place, np.where(good, places, 0)])
        return good

    def _gains(self, problem: _Problem, solved: _Solved) -> Array:
        """Log odds (H, K, M) of a step before each measurement, or a foreign spot in it, by kind."""
        heliostats = len(self.kind)
        pull = solved.precision_y.reshape(heliostats, self.most, 2)
        blocks = solved.precision(problem).reshape(heliostats, self.most, 2, self.most, 2)
        foreign_hess = np.einsum("hiaib->hiab", blocks)
        step_pull = _from_here(np.einsum("hmka,hmk->hma", problem.by_zero, pull), 1)
        step_hess = _of_pairs(problem.by_zero, blocks)
        noise, used = problem.noise, problem.readings.used
        variances = _variances(noise)
        of_steps = [_gain(step_pull, step_hess, variances[kind]) for kind in _STEPS]
        of_foreign = [_gain(pull, foreign_hess, variances[kind]) for kind in _FOREIGN]
        gains = np.stack([*of_steps, *of_foreign], axis=1)
        gains += np.log(_odds(noise))[1:, None]
        steps = slice(0, len(_STEPS))
        gains[:, steps, 0] = -np.inf  # a step before the first is the zero itself
        gains[:, steps] = np.where(self.mask(*_STEPS)[:, None], -np.inf, gains[:, steps])
        foreign = slice(len(_STEPS), None)
        gains[:, foreign] = np.where(self.mask(*_FOREIGN)[:, None], -np.inf, gains[:, foreign])
        return np.where(used[:, None], gains, -np.inf)

    def shed(self, problem: _Problem) -> None:
        """Drop beliefs whose odds are against them by now, the worst of a heliostat first."""
        while self.kind.any():
            solved = self.solve(problem)
            heliostats, count = self.kind.shape
            cov = np.einsum("htatb->htab", solved.cov.reshape(heliostats, count, 2, count, 2))
            size = solved.sizes.reshape(heliostats, count, 2)
            surprise = (size * np.linalg.solve(cov, size[..., None])[..., 0]).sum(axis=-1)
            variance = _variances(problem.noise)[self.kind]
            gain = 0.5 * (surprise + np.linalg.slogdet(cov)[1] - np.log(variance).sum(axis=-1))
            gain += np.log(_odds(problem.noise))[self.kind]
            gain[self.kind == 0] = np.inf
            worst = gain.argmin(axis=1)
            rows = np.nonzero(gain[np.arange(heliostats), worst] < 0)[0]
            if not len(rows):
                return
            self.kind[rows, worst[rows]] = 0

    def begun(self, solved: _Solved) -> tuple[Array, Array]:
        """Steps (H, M, 2) [rad] where they begin, and their standard deviations (H, M, 2) [rad]."""
        heliostats, count = self.kind.shape
        size, std = np.zeros((2, heliostats, self.most, 2))
        rows, terms = np.nonzero(np.isin(self.kind, _STEPS))
        places = self.place[rows, terms]
        size[rows, places] = solved.sizes.reshape(heliostats, count, 2)[rows, terms]
        variance = np.diagonal(solved.cov, axis1=1, axis2=2).reshape(heliostats, count, 2)
        std[rows, places] = np.sqrt(variance[rows, terms])
        return size, std


def _of_pairs(columns: Array, blocks: Array) -> Array:
    """Information (H, M, A, A) on what begins at a measurement: the sum of all pairs of those from it on.

    ``columns`` (H, M, 2, A) are what it moves, ``blocks`` (H, M, 2, M, 2) the precision. From one measurement to the
    next come the pair of it with itself, and those with all later ones, twice.
    """
    heliostats, most, _, count = columns.shape
    half = columns.swapaxes(2, 3) @ blocks.reshape(heliostats, most, 2, 2 * most)
    own = np.einsum("hiail->hial", half.reshape(heliostats, most, count, most, 2)) @ columns
    half *= (np.arange(2 * most) // 2 > np.arange(most)[:, None])[:, None]
    later = half.reshape(heliostats, count * most, 2 * most) @ columns.reshape(heliostats, 2 * most, count)
    later = later.reshape(heliostats, most, count, count)
    return _from_here(own + later + later.swapaxes(2, 3), 1)


def _odds(noise: Noise) -> Array:
    """Of each kind of term (K,); one of none has even ones."""
    step, foreign = noise.step_odds / len(_STEPS), noise.foreign_odds / len(_FOREIGN)
    return np.array([1.0] + [step] * len(_STEPS) + [foreign] * len(_FOREIGN))


def _variances(noise: Noise) -> Array:
    """Of the two sizes of each kind of term (K, 2) [rad2]."""
    of_steps = [
        [size * first, size * second]
        for size in noise.step_rad
        for first, second in ((1.0, 1.0), (1.0, _STILL), (_STILL, 1.0))
    ]
    return np.square([[1.0, 1.0], *of_steps, *([size, size] for size in noise.foreign_rad)])


def _gain(pull: Array, hess: Array, variance: Array) -> Array:
    """Log of the Bayes factor (...) for a term of two sizes, by their pull (..., 2) and information (..., 2, 2)."""
    inner = hess + np.diag(1 / variance)
    size = np.linalg.solve(inner, pull[..., None])[..., 0]
    return np.asarray(0.5 * ((pull * size).sum(axis=-1) - np.linalg.slogdet(inner)[1] - np.log(variance).sum()))


def _from_here(values: Array, axis: int) -> Array:
    """Sums from each place on to the end."""
    return np.flip(np.flip(values, axis).cumsum(axis), axis)
