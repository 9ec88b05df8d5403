"""What every number that `study register` writes means, as it stands in the files themselves."""

from __future__ import annotations

from study.quality import QUALITY_LIMITS

FILES = {
    "warped.ply": "CT points in the US frame, mm",
    "waypoints_us.csv": "waypoints in the US frame, mm",
    "waypoints_us.mrk.json": "the same for 3D Slicer",
    "waypoints_robot.json": "the same for a planner, with normals, quality and bounds",
    "displacement.nii.gz": "displacement field, US to CT, for ITK",
    "rigid.tfm": "rigid part only, US to CT, for ITK (the coarse step of most methods: not for a probe to follow)",
    "registration.json": "quality, warnings, inputs, and what every number means",
}

FRAMES = {
    "CT": "the frame of the CT points, mm; x, y, z as in the file where it says comment SPACE=RAS or nothing, with x "
    "and y of the opposite sign where it says LPS",
    "US": "the frame of the US points, mm, of a sweep the base frame of its tracker or robot; x, y, z as in their "
    "file where it says comment SPACE=RAS or nothing, with x and y of the opposite sign where it says LPS",
}

MEANINGS = {
    "T_us_ct": "4 x 4, row by row: CT frame to US frame, RAS, mm; the rigid part only, see T_us_ct_is_all",
    "T_us_ct_is_all": "true of a rigid method: its result is this motion and nothing else",
    "beyond_rigid_mm": "how far the result moves CT points beyond the rigid part, mm: mean and largest",
    "converged": "false when the method was stopped before it was at rest, or branches are swapped",
    "field": "the displacement field, where one was asked for",
    "field.in_grid_share": "share 0-1 of the warped points that lie in the grid",
    "field.no_inverse_share": "share 0-1 of the places worked out at which the deformation has no inverse",
    "field.return_mm": "how far from its CT point the field takes each warped point, mm: mean, 19 in 20, largest",
    "field.spacing_mm": "between voxels along the image's own axes, mm",
    "field.voxels": "along the image's own axes",
    "format_version": "of this file's layout",
    "front": "direction from the chest to the probe in the US frame, RAS, as given; null where it was not",
    "inputs": "the files that were read: name, SHA-256 of the bytes, number of points, and the space that the file "
    "states (null: none, RAS was assumed)",
    "n_iterations": "iterations of the method; what one is depends on it",
    "n_points": "points of warped.ply; row i is point i of the CT file",
    "parameters": "of the method, as its class in study.methods documents them",
    "quality": "measures of the result that need no truth",
    "quality.residual_share": "share 0-1 of the US points farther than 5 mm from the warped CT points",
    "quality.wrong_part_share": "share 0-1 of warped cartilage points whose nearest US point is on another cartilage",
    "quality.further_motion_mm": "mean distance that the method moved points after the coarse alignment, mm",
    "quality.stretched_share": "share 0-1 of links between neighbours that became over twice or under half as long",
    "quality.folded_share": "share 0-1 of points around which the view from the front was turned over",
    "radius_mm": "sphere around a waypoint whose points carry it, mm; of no effect for a method with a field",
    "seed": "of the method's draws",
    "warnings": "what makes the result, or the waypoint or field named, suspect: no probe should follow it; quality "
    "warns above " + ", ".join(f"{name} {limit:g}" for name, (limit, _) in QUALITY_LIMITS.items()),
}

ROBOT_MEANINGS = {
    "waypoints": "in the order of the file that was read",
    "index": "counted from 0, in that order",
    "carried": "false: the waypoint has no place in the US frame, and reason says why; a path has a gap there",
    "position": "x, y, z in the frame named above, mm, as deep as picked in the CT: not on the skin",
    "normal": "unit vector from the chest to the skin in the same frame; a probe on the skin looks the opposite way",
    "normal_from": "surface: of the plane through the US points within 30 mm; chest: too few, so the front",
    "bound_mm": "19 times in 20 the position is at most this far from its true place, on people like those of the "
    "calibration; null of a method without bounds, and of a suspect result",
    "quality.ct_distance_mm": "from the waypoint to the nearest CT point, in the CT frame",
    "quality.us_residual_mm": "median distance to the nearest warped CT point of the US points within 30 mm; null "
    "without any",
    "quality.n_us_points": "US points within 30 mm: 0 where the ultrasound saw nothing",
    "suspect": "true where there are warnings: no probe should follow these waypoints",
}
