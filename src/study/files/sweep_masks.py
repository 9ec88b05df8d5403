"""Masks of a sweep's frames, however they were made: drawn in 3D Slicer, by a network, or as a folder of PNGs."""

from __future__ import annotations

import re
from collections.abc import Sequence as Rows
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray

from study.errors import StudyError
from study.files.headers import itk_geometry
from study.files.nifti import read_nifti_header
from study.files.nrrd_arrays import NrrdArray, read_nrrd_array
from study.files.sequences import numbers_of, read_sequence, turned
from study.files.stored import read_pixels
from study.types import Bools, Floats

SAME_TIME_S = 1e-3  # stamps are rounded to a millisecond or less; frames lie 10 ms and more apart
ON_GRID = 0.01  # of a pixel, for headers of few digits
SEGMENT = re.compile(r"Segment(\d+)_(\w+)")


def check_masks(stack: NDArray[Any], name: str) -> None:
    """Pixels are 0 or one other value, as masks are and B-mode is not.

    Raises:
        StudyError: several values.
    """
    top = stack.max()
    if not ((stack == 0) | (stack == top)).all():
        raise StudyError(
            f"{name}: expected masks of 0 and one other value, got {len(np.unique(stack))} grey levels; is this the"
            " B-mode? export the annotation alone"
        )


def read_mask_stack(
    path: Path,
    shape: tuple[int, ...],
    times: Floats,
    images: str,
    *,
    orientation: str = "MF",
    segments: Rows[str] | None = None,
) -> tuple[NDArray[Any], tuple[str, ...]]:
    """The masks of a recording's frames.

    Args:
        path: a segmentation of 3D Slicer (``.seg.nrrd``), a sequence or stack (``.nrrd``, ``.mha``), NIfTI
            (``.nii``, ``.nii.gz``), or a folder of one PNG a frame, numbered in their order.
        shape: (f, h, w) of the recording's frames as they are stored.
        times: (f,) s, their stamps.
        images: the recording's name, for messages.
        orientation: of the recording as it is stored; that of the masks too where they state none.
        segments: names in a ``.seg.nrrd`` that count; its only one when None.

    Returns:
        (f, h, w) in the orientation MF, 0 outside; and what was assumed, a sentence each.

    Raises:
        StudyError: no such file, another format, another size or other stamps, several segments and none named, or
            pixels that are no masks.
    """
    notes: tuple[str, ...] = ()
    if segments is not None and not path.name.lower().endswith(".seg.nrrd"):
        raise StudyError(f"{path.name}: expected a .seg.nrrd to choose segments of, got another format; leave them out")
    if path.is_dir():
        bones: NDArray[Any] = read_png_masks(path, _numbered(path, len(times), images))
    elif path.name.lower().endswith(".seg.nrrd"):
        bones, notes = _segmentation(read_nrrd_array(_there(path)), shape, segments)
    elif path.name.lower().endswith((".nii", ".nii.gz")):
        bones, notes = _nifti(_there(path), shape)
    else:
        return _sequence(path, shape, times, images, orientation), ()
    if bones.shape != shape:
        raise _mis_sized(path.name, shape, bones.shape)
    check_masks(bones, path.name)
    return turned(bones, orientation, path.name), notes


def _there(path: Path) -> Path:
    if not path.is_file():
        raise StudyError(f"{path.name}: expected masks, got nothing at {path}; check the path")
    return path


def _mis_sized(name: str, shape: tuple[int, ...], found: tuple[int, ...]) -> StudyError:
    return StudyError(f"{name}: expected masks of the size of the images {shape}, got {found}; export all frames alike")


def _sequence(path: Path, shape: tuple[int, ...], times: Floats, images: str, orientation: str) -> NDArray[Any]:
    """Masks of a sequence file or a plain stack, in the orientation MF."""
    found = read_sequence(path)
    if found.content not in ("masks", None):
        raise StudyError(
            f"{path.name}: expected masks, got a file that says it holds {found.content}; give the annotation"
        )
    bones = found.turned(without=orientation)
    wanted = turned(np.empty(shape, dtype=bool), orientation, images).shape
    if bones.shape != wanted:
        raise _mis_sized(path.name, wanted, bones.shape)
    check_masks(bones, path.name)
    for i, fields in enumerate(found.frames):
        if "Timestamp" not in fields:  # other programs keep none: then only the size can tell
            continue
        time = float(numbers_of(path.name, fields, "Timestamp", 1, f"frame {i}: ")[0])
        if not abs(time - times[i]) < SAME_TIME_S:
            raise StudyError(
                f"{path.name}: frame {i}: expected the time stamp of {images}, {times[i]:.6f} s, got {time:.6f} s;"
                " these are masks of another recording"
            )
    return bones


def _segmentation(
    found: NrrdArray, shape: tuple[int, ...], segments: Rows[str] | None
) -> tuple[Bools, tuple[str, ...]]:
    """Frames (f, h, w) of the named segments, out of the box that 3D Slicer crops a segmentation to."""
    table: dict[str, dict[str, str]] = {}
    for key, value in found.fields.items():
        if match := SEGMENT.fullmatch(key):
            table.setdefault(match[1], {})[match[2]] = value
    named = {entry.get("Name", number): entry for number, entry in table.items()}
    if not named:
        raise StudyError(f"{found.name}: expected segments (Segment0_Name ...), got none; save it from Slicer again")
    if segments is None and len(named) > 1:
        raise StudyError(
            f"{found.name}: expected one segment, got {', '.join(sorted(named))}; name those that are bone or cartilage"
        )
    chosen = list(named) if segments is None else list(segments)
    if not chosen or not set(chosen) <= set(named):
        raise StudyError(
            f"{found.name}: expected segments {', '.join(chosen) or '(none named)'}, got {', '.join(sorted(named))};"
            " check the names"
        )
    layers: NDArray[Any] = found.values
    if layers.ndim == 3:
        layers = layers[None]
    elif layers.ndim != 4 or found.kinds[0] != "list":
        raise StudyError(f"{found.name}: expected layers of a stack, got the kinds {' '.join(found.kinds)}; save again")
    inside: NDArray[Any] = np.zeros(layers.shape[1:], dtype=bool)
    for name in chosen:
        label, layer = (named[name].get(key, default) for key, default in (("LabelValue", "1"), ("Layer", "0")))
        if not (label.isdigit() and layer.isdigit() and int(layer) < len(layers)):
            raise StudyError(f"{found.name}: expected a label and a layer of segment {name}, got {label!r}, {layer!r}")
        inside |= layers[int(layer)] == int(label)
    box: NDArray[Any] = inside.transpose(2, 1, 0)
    offset = found.fields.get("Segmentation_ReferenceImageExtentOffset", "").split()
    placed = _on_grid(box, found.grid(), shape)
    if placed is not None:
        return placed, ()
    if len(offset) == 3 and all(re.fullmatch(r"-?\d+", part) for part in offset):
        i, j, k = (int(part) for part in offset)
        n_frames, rows, columns = len(box), box.shape[1], box.shape[2]
        whole = np.zeros(shape, dtype=bool)
        if min(i, j, k) >= 0 and whole[k:, j:, i:][:n_frames, :rows, :columns].shape == box.shape:
            whole[k : k + n_frames, j : j + rows, i : i + columns] = box
            return whole, (f"{found.name} was placed by its offset {i} {j} {k} in its reference image",)
    return box, (f"{found.name} has another grid than the recording: taken frame by frame, pixel by pixel",)


def _nifti(path: Path, shape: tuple[int, ...]) -> tuple[NDArray[Any], tuple[str, ...]]:
    stored = read_nifti_header(path, path.name)
    stack = read_pixels(stored, path.name).transpose(2, 1, 0)
    spacing, axes, origin = itk_geometry(path, stored.shape, path.name)
    placed = _on_grid(stack, ((axes * spacing).T, origin), shape)
    if placed is not None:
        return placed, ()
    return stack, (f"{path.name} has another grid than the recording: taken frame by frame, pixel by pixel",)


def _on_grid(box: NDArray[Any], grid: tuple[Floats, Floats] | None, shape: tuple[int, ...]) -> NDArray[Any] | None:
    """A stack put where its header says on PLUS's grid, which is 1 along x, y and frames from 0; None beside it.

    Args:
        box: (frames, rows, columns), perhaps cropped, perhaps running backwards along some axis.
        grid: steps (3, 3) of columns, rows and frames, and the first voxel's place (3,), both LPS.
        shape: (f, h, w) of the whole.
    """
    if grid is None:
        return None
    steps, origin = grid
    signs = np.diag(steps)
    first = np.rint(origin).astype(np.int64)
    last = first + np.rint(signs).astype(np.int64) * (np.array(box.shape[::-1]) - 1)
    size = np.array(shape[::-1])
    straight = np.allclose(steps, np.diag(signs), atol=ON_GRID) and np.allclose(np.abs(signs), 1.0, atol=1e-4)
    if not straight or not np.allclose(origin, first, atol=ON_GRID):
        return None
    low, high = np.minimum(first, last), np.maximum(first, last)
    if (low < 0).any() or (high >= size).any():
        return None
    whole = np.zeros(shape, dtype=box.dtype)
    flipped = np.flip(box, axis=tuple(2 - axis for axis in range(3) if signs[axis] < 0))
    whole[tuple(slice(low[2 - axis], high[2 - axis] + 1) for axis in range(3))] = flipped
    return whole


def _numbered(folder: Path, n_frames: int, images: str) -> list[str]:
    """The PNGs of a folder in the order of their numbers, one a frame."""
    names = [path.name for path in folder.iterdir() if path.suffix.lower() == ".png" and not path.name.startswith(".")]
    order = {name: tuple(int(digits) for digits in re.findall(r"\d+", name)) for name in names}
    if len(names) != n_frames or len(set(order.values())) != len(names):
        raise StudyError(
            f"{folder.name}: expected a numbered PNG for each of the {n_frames} frames of {images}, got {len(names)}"
            f" with {len(set(order.values()))} different numbers; an empty one stands for a frame without bone"
        )
    return sorted(names, key=order.__getitem__)


def read_png_masks(folder: Path, names: Rows[str], listed: str | None = None) -> Bools:
    """Masks (f, h, w) of a folder's grey PNGs; every image's size is checked before its pixels are read.

    Args:
        folder: the folder.
        names: of the images, relative to it.
        listed: the file that names them, for messages.

    Raises:
        StudyError: a name outside the folder or of no image, colour, another size, or no mask.
    """
    masks, reader = None, sitk.ImageFileReader()
    for i, name in enumerate(names):
        path = folder / name
        if not path.resolve().is_relative_to(folder.resolve()) or not path.is_file():
            raise StudyError(
                f"{listed or folder.name}: expected {name!r} to be an image in the folder, got none; correct row {i}"
            )
        reader.SetFileName(str(path))
        try:
            reader.ReadImageInformation()
            size, channels = reader.GetSize(), reader.GetNumberOfComponents()
            if channels != 1 or len(size) != 2:
                raise StudyError(
                    f"{name}: expected a grey image, got {channels} channels; save masks as 8-bit grey PNG"
                )
            if masks is None:
                masks = np.zeros((len(names), size[1], size[0]), dtype=bool)
            if (size[1], size[0]) != masks.shape[1:]:
                raise StudyError(
                    f"{name}: expected {masks.shape[2]} x {masks.shape[1]} pixels as in the first mask, got"
                    f" {size[0]} x {size[1]}; export all frames alike"
                )
            pixels = sitk.GetArrayFromImage(reader.Execute())
            check_masks(pixels, name)
            masks[i] = pixels > 0
        except RuntimeError as error:
            raise StudyError(
                f"{name}: expected a readable image, got a damaged one ({type(error).__name__}); export it again"
            ) from error
    assert masks is not None  # there are frames
    return masks
