import numpy as np

from study.evaluation.statistics import population_sd


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
