"""Quiet breathing as a sweep meets it: no breath is like the one before, and none is a sine (sec. II-C.2).

Shape: Lujan et al., Med Phys 26:715 (1999), cos^2n from one end of expiration to the next, here with its rising half as
long as the inspiration and its falling half as long as the expiration. Spread from breath to breath: coefficients of
variation of 65 healthy people at rest over 15 minutes, Tobin et al., J Appl Physiol 65:309 (1988). What is assumed is
said to be at its constant. Not modelled: a drift of the level at the end of expiration, sighs, and the memory that one
breath has of the last.
"""

from __future__ import annotations

from math import comb

import numpy as np

from study.types import Floats

BREATHS_PER_MIN = (12.0, 20.0)  # mean of a person at rest, any in this range, pauses included (textbook range)
SHAPES = (1, 2, 3)  # n of Lujan's cos^2n, one a person; 1 is a sine but for its halves, 3 is flat for longer (assumed)
DURATION_CV = 0.208  # of one breath; Tobin 1988, of the frequency
DEPTH_CV = 0.33  # of one breath; Tobin 1988, of the tidal volume, which the chest wall is assumed to follow
INSPIRATION = 0.38  # mean share of a breath (assumed: shorter than what follows it, in every breath)
INSPIRATION_CV = 0.179  # Tobin 1988
MAX_PAUSE = 0.4  # of what follows the inspiration, 0 to this, spent at rest before the next one (assumed)
LEAD_BREATHS = 10  # before the sweep: by then a start at any phase is likely as any other


def quiet_breathing(times_s: Floats, depth_mm: float, rng: np.random.Generator) -> Floats:
    """Displacement of the chest wall from its mean position, inspiration positive.

    The mean is that of the long run, over breaths without end, which is where the truth of a patient lies; over one
    sweep, which may be shorter than a breath, the displacement has a mean of its own.

    Args:
        times_s: (n,) s, 0 or later.
        depth_mm: end of expiration to end of inspiration, mean over breaths.
        rng: draws the person's pace and shape, and the breaths.

    Returns:
        (n,) mm.

    Forty seconds of one person: how many breaths, and how high the lowest and the highest reach above the mean, mm:

    >>> t = np.arange(0, 40, 0.01)
    >>> s = quiet_breathing(t, 4.0, np.random.default_rng(0))
    >>> peaks = s[1:-1][(s[1:-1] > s[:-2]) & (s[1:-1] >= s[2:])]
    >>> len(peaks), float(peaks.min().round(1)), float(peaks.max().round(1))
    (10, 2.0, 5.5)
    """
    mean_s = 60 / rng.uniform(*BREATHS_PER_MIN)
    n = int(rng.choice(SHAPES))
    start_s = -(LEAD_BREATHS + rng.uniform()) * mean_s
    raised = np.zeros(len(times_s))  # above the end of expiration, shares of the mean depth
    end_s = start_s
    while end_s <= times_s.max():
        start_s = end_s
        end_s = start_s + mean_s * _varied(DURATION_CV, rng)
        depth = _varied(DEPTH_CV, rng)
        share = INSPIRATION * (1 + np.sqrt(3) * INSPIRATION_CV * rng.uniform(-1, 1))
        moving = share + (1 - share) * (1 - rng.uniform(0, MAX_PAUSE))
        mine = (times_s >= start_s) & (times_s < end_s)
        passed = (times_s[mine] - start_s) / (end_s - start_s)
        # Half a period of Lujan's cosine for the rise, half for the fall, then rest.
        raised[mine] = depth * np.sin(np.pi / 2 * np.interp(passed, [0.0, share, moving], [0.0, 1.0, 2.0])) ** (2 * n)
    mean_moving = INSPIRATION + (1 - INSPIRATION) * (1 - MAX_PAUSE / 2)
    mean_raised = mean_moving * comb(2 * n, n) / 4**n  # the second factor is the mean of cos^2n
    displacement: Floats = depth_mm * (raised - mean_raised)
    return displacement


def _varied(cv: float, rng: np.random.Generator) -> float:
    """A positive draw of mean 1 and coefficient of variation ``cv``: log-normal (assumed)."""
    variance = np.log1p(cv**2)
    return float(np.exp(rng.normal(-variance / 2, np.sqrt(variance))))
