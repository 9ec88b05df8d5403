import numpy as np
import pytest

from study.errors import StudyError
from study.evaluation.statistics import paired_wilcoxon, population_sd


def test_population_sd_reproduces_the_papers_table():
    table = {
        3.54: [10.92, 20.67, 18.35, 16.50, 20.29],
        3.36: [14.45, 10.49, 12.43, 15.06, 20.48],
        3.27: [11.75, 15.96, 15.62, 10.56, 19.71],
        0.27: [9.81, 9.53, 9.06, 9.69, 9.29],
    }
    for sd, values in table.items():
        assert round(population_sd(values), 2) == sd
        assert round(float(np.std(values, ddof=1)), 2) != sd


def test_five_pairs_get_no_p_value_and_six_can():
    first = np.array([5.0, 6.0, 7.0, 8.0, 9.0, 10.0])
    second = first - [1, 2, 3, 4, 5, 6]
    five, six = paired_wilcoxon(first[:5], second[:5]), paired_wilcoxon(first, second)
    assert (five.n, five.p_value) == (5, None)
    assert "n = 5 < 6" in five.note
    assert six.p_value == pytest.approx(2 / 2**6)
    assert six.mean_difference == pytest.approx(3.5)
    assert paired_wilcoxon(first, first).p_value == 1
    with pytest.raises(StudyError, match="leave failures out"):
        paired_wilcoxon(first, [*second[:5], np.nan])
