"""Sizes of chest walls, mean and SD over people, from which the synthetic people are drawn."""

from __future__ import annotations

# Published, mean and SD in mm: (female, male), and both together by level.
MANUBRIUM_MM = ((46.7, 5.1), (51.2, 6.0))
BODY_MM = ((86.6, 9.7), (102.4, 13.3))
CARTILAGE_MM = {4: (55.8, 9.8), 5: (70.0, 10.8)}
STERNAL_ANGLE_DEG = 163.0
# What no publication gives, measured on the four people of the open cohort (results/anatomy.csv, mean and population SD
# over people of the mean of both sides).
MEASURED_LENGTH_MM = {2: (40.1, 7.0), 3: (47.2, 3.8)}
MEASURED_WIDTH_MM = {2: 10.6, 3: 11.7, 4: 12.0, 5: 12.3}
MEASURED_THICKNESS_MM = (8.6, 1.15)  # of all eight cartilages
MEASURED_STERNUM_MM = ((24.0, 2.2), 10.7)  # width and its SD, thickness
MEASURED_HU = (101.7, 5.0)
# Curvature across the front, 1/m: the upper part of the -0.8 to 6.3 measured. Whether the flattest are seen from the
# front or from behind, nothing in a cloud could tell.
WALL_PER_M = (4.3, 1.5)
MAX_SD = 1.3  # draws are cut there: different people, no outliers
