# SPDX-License-Identifier: Apache-2.0
"""What a robot needs of lifted points: frames of joints, angles, forward kinematics, URDF, motion.

Legend: n objects, p keypoints, j joints, a angles. Frames are x front, y left, z up (REP-103) at
rest; angles are in radians; lengths and positions are in the unit of the points.

- `kinematic_tree.py`: frames and angles of a layout's joints, and the way back to points.
- `urdf.py`: the description of one object as URDF text, and its drawing as capsules.
- `floor.py`: metres from the height of the camera above the floor.
- `motion.py`: velocities and the state of tracking of each identity.
"""
