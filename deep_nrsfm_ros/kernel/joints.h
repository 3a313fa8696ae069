/* SPDX-License-Identifier: Apache-2.0 */
/* Frames and angles of joints: body/kinematic_tree.py. */
#ifndef JOINTS_H
#define JOINTS_H

#include <stddef.h>

enum { FREE_JOINT, HINGE_JOINT, AIMED_JOINT };
enum { MAX_OTHERS = 3 };

/* A joint with a frame of its own, in the order of body/kinematic_tree.py. Angles below 0: there are none. */
typedef struct {
    int kind, proper, joint, parent, pair, others, other_pairs[MAX_OTHERS], angles[3];
} JointIndices;

typedef struct {
    double first[3], others[MAX_OTHERS][3], weights[MAX_OTHERS], basis[9], to_axes[9], signs[3];
    double max_twist, parent_weight, elevation;
} JointConstants;

enum { JOINT_INDICES = sizeof(JointIndices) / sizeof(int), JOINT_CONSTANTS = sizeof(JointConstants) / sizeof(double) };

/* k joints with frames, of j joints, m directions and a angles. */
typedef struct {
    ptrdiff_t k, j, m, a;
    const JointIndices *indices;
    const JointConstants *constants;
} JointTree;

/* Return whether all indices are within j, m and a, and parents come before their children. */
int joints_are_sound(const JointTree *tree);

/* Fill rotations (n, j, 3, 3) of the k joints and angles (n, a) from the directions (n, m, 3). */
void joint_frames(const JointTree *tree, ptrdiff_t n, const double *directions, double *rotations, double *angles);

/* Fill quaternions (n, 4), x y z w, w >= 0, of rotations (n, 3, 3). */
void rotations_to_quaternions(ptrdiff_t n, const double *rotations, double *quaternions);

#endif
