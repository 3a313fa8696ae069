# SPDX-License-Identifier: Apache-2.0
from typing import Any

FLOATS: int  # columns of a panel
DOUBLES: int  # to a multiple of which rows of doubles are filled up
MAX_LAYERS: int  # of a network
MAX_KEYPOINTS: int  # of a network
MAX_WIDTH: int  # of a dictionary of a network, in atoms

def plan(header: Any, floats: Any, doubles: Any, /) -> object:
    """Return the plan of a lifter: its constants in the kernel's layout, and memory to compute in.

    Args:
        header: int32: counts, flags, widths and indices of keypoints.
        floats: float32: weights of the network, error covariance.
        doubles: float64: constants of the correction and of the confidence.

    Raises:
        TypeError: An argument is no C-contiguous array of its item type.
        ValueError: A count, index or length is out of range.
    """

def lift(
    plan: object, points: Any, confidence: Any, perspective: bool, context: Any, /, *outputs: Any
) -> None:
    """Lift n objects and fill the outputs, which must not overlap other arrays.

    Args:
        plan: as `plan` returned it.
        points: (n, p, 2) float32.
        confidence: (n, p) float32, 0 = missing.
        perspective: whether points are where rays meet the plane z = 1.
        context: None, or `lifting.history.Context`, whose states are updated.
        outputs: the seven arrays of `lifting.Lifted`, float32 but for `wrong` of bool, and (n,)
            bool: not lifted.

    Raises:
        TypeError: An argument is no C-contiguous array of its item type.
        ValueError: The arrays do not fit the plan and each other.
        RuntimeError: The plan is in use by another lift.
    """

def worker_pool(header: Any, L: Any, L_inverse: Any, /) -> object:
    """Return the threads' memory for the passes of a network in training.

    Args:
        header: int32: keypoints p, layers, 1 if whitened, frames of a block, threads, widths.
        L: (p, p) float32, whitening.
        L_inverse: (p, p) float32.

    Raises:
        TypeError: An argument is no C-contiguous array of its item type.
        ValueError: A number is out of range, or there is no memory.
    """

def activations_per_frame(pool: object, /) -> int:
    """Return how many floats the forward pass keeps of a frame for the backward pass."""

def network_forward(
    pool: object, weights: Any, x: Any, activations: Any, S: Any, M_T: Any, /
) -> None:
    """Compute the forward pass of n frames and fill the outputs.

    Args:
        pool: as `worker_pool` returned it.
        weights: float32, in the order of `Network.trainable_weights`.
        x: (n, 2, p) float32, the network's input.
        activations: output (n, activations_per_frame) float32.
        S: output (n, 3, p) float32.
        M_T: output (n, 2, 3) float32.

    Raises:
        TypeError: An argument is no C-contiguous array of its item type.
        ValueError: The arrays do not fit the network and each other.
        RuntimeError: The pool is in use by another call.
    """

def network_backward(
    pool: object, weights: Any, activations: Any, S_bar: Any, M_T_bar: Any, gradient: Any, /
) -> None:
    """Compute the gradient by the weights from the gradients by S and M^T.

    Args:
        pool: as `worker_pool` returned it.
        weights: those of the forward pass.
        activations: those of the forward pass.
        S_bar: (n, 3, p) float32.
        M_T_bar: (n, 2, 3) float32.
        gradient: output float32, in the order of the weights.

    Raises:
        TypeError: An argument is no C-contiguous array of its item type.
        ValueError: The arrays do not fit the network and each other.
        RuntimeError: The pool is in use by another call.
    """

def decode_keypoints(
    data: Any,
    messages: tuple[int, int],
    objects: tuple[int, int],
    steps: tuple[int, int],
    offsets: tuple[int, int, int],
    max_coordinate: float,
    min_confidence: float,
    points: Any,
    confidence: Any,
    /,
) -> None:
    """Read the keypoints of serialised messages that differ in their data alone.

    Args:
        data: bytes of all messages.
        messages: how many, and bytes from one to the next.
        objects: n objects of a message, and p keypoints of an object.
        steps: bytes from an object to the next, and from a keypoint to the next.
        offsets: bytes to the first x, y and confidence, little-endian float32; -1: no confidence.
        max_coordinate: keypoints with a coordinate of this size or more are missing.
        min_confidence: keypoints with less confidence are missing.
        points: output (messages n, p, 2) float32, 0 where missing.
        confidence: output (messages n, p) float32 in [0, 1], 0 where missing.

    Raises:
        TypeError: An argument is no C-contiguous array of its item type.
        ValueError: A number is out of range, or the arrays do not fit the data.
    """

def steady_depths(
    time: float, constants: Any, states: Any, rows: Any, shapes: Any, rotations: Any, /
) -> None:
    """Make the depths of n objects of p points steady: `lifting.steady_depth`.

    Args:
        time: of the frame in seconds.
        constants: float64, in the order of `steady_depth`.
        states: (capacity, 1 + 7 p) float64, updated.
        rows: (n,) int32, the row of each object; below 0: none.
        shapes: (n, p, 3) float32, changed.
        rotations: (n, 3, 3) float32, changed.

    Raises:
        TypeError: An argument is no C-contiguous array of its item type.
        ValueError: The arrays do not fit each other.
    """

def match_tracks(
    constants: Any,
    points: Any,
    confidence: Any,
    passed: Any,
    track_points: Any,
    age: Any,
    velocity: Any,
    size: Any,
    sigma: Any,
    score: Any,
    shift: Any,
    best: Any,
    /,
) -> None:
    """Compare n detections with m tracks of `lifting.track_matching`; fill the outputs.

    Args:
        constants: float32, in the order of `track_matching`.
        points: (n, q, 2) float32, pixels.
        confidence: (n, q) float32, 0 = missing.
        passed: (m,) float32, seconds since the last detection of the tracks.
        track_points: (m, q, 2) float32, pixels.
        age: (m, q) float32, seconds.
        velocity: (m, 2) float32, pixels per second.
        size: (m,) float32, pixels.
        sigma: (q,) float32, sizes of the object.
        score: output (n, m) float32.
        shift: output (n, m, 2) float32, pixels.
        best: output (n,) int32, track of the highest score above 0; -1: none.

    Raises:
        TypeError: An argument is no C-contiguous array of its item type.
        ValueError: The arrays do not fit each other.
    """

def update_tracks(
    constants: Any,
    points: Any,
    confidence: Any,
    passed: Any,
    track_points: Any,
    age: Any,
    velocity: Any,
    size: Any,
    assigned: Any,
    shift: Any,
    /,
) -> None:
    """Update the arrays of m tracks by the detections that are assigned to them.

    Args:
        constants: as in `match_tracks`.
        points: as in `match_tracks`.
        confidence: as in `match_tracks`.
        passed: as in `match_tracks`.
        track_points: changed.
        age: changed.
        velocity: changed.
        size: changed.
        assigned: (n,) int32, track of each detection; below 0: none.
        shift: (n, m, 2) float32, as `match_tracks` filled it.

    Raises:
        TypeError: An argument is no C-contiguous array of its item type.
        ValueError: The arrays do not fit each other.
    """

def choose_vectors(bytes: int, /) -> int:
    """Set how many bytes a vector of the processor has: 16, 32 or 64; return what it supports.

    For tests, which try all of them. It holds for the whole process.
    """

def joint_frames(
    indices: Any,
    constants: Any,
    directions: Any,
    rotations: Any,
    angles: Any,
    sizes: tuple[int, int],
    /,
) -> None:
    """Fill the frames and angles of joints: `KinematicTree` lays out the arguments.

    Args:
        indices: (k, 12) int32: kinds and indices of the joints with frames of their own.
        constants: (k, 39) float64.
        directions: (n, m, 3) float64, measured.
        rotations: output (n, j, 3, 3) float64; only the joints that `indices` name are filled.
        angles: output (n, a) float64; only those that `indices` name are filled.
        sizes: n and j, at least 1.

    Raises:
        TypeError: An argument is no C-contiguous array of its item type.
        ValueError: The arrays do not fit each other, or an index is out of range.
    """

def quaternions(rotations: Any, quaternions: Any, /) -> None:
    """Fill unit quaternions (n, 4), x y z w, w >= 0, of rotations (n, 3, 3), both float64.

    Raises:
        TypeError: An argument is no C-contiguous array of its item type.
        ValueError: The arrays do not fit each other.
    """
