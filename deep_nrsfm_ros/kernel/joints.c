/* SPDX-License-Identifier: Apache-2.0 */
/* Frames and angles of joints: the formulas are those of body/kinematic_tree.py, which test/body compares. */
#include "joints.h"

#include <math.h>
#include <stdlib.h>

static const double SMALL = 1e-9, GIMBAL = 1e-6, FAR = 2.0943951023931953;

static int within(int index, ptrdiff_t size) { return index >= 0 && index < size; }

int joints_are_sound(const JointTree *tree) {
    char *has_frame = calloc((size_t)tree->j, 1);
    int sound = has_frame != NULL;
    for (ptrdiff_t i = 0; sound && i < tree->k; i++) {
        const JointIndices *x = tree->indices + i;
        sound = x->kind >= FREE_JOINT && x->kind <= AIMED_JOINT && within(x->joint, tree->j) && within(x->pair, tree->m) &&
                    x->others >= 0 && x->others <= MAX_OTHERS && x->parent < tree->j;
        sound = sound && (x->parent < 0 || has_frame[x->parent]);
        for (int s = 0; sound && s < x->others; s++) sound = within(x->other_pairs[s], tree->m);
        for (int s = 0; sound && s < 3; s++) sound = x->angles[s] < tree->a;
        if (sound) has_frame[x->joint] = 1;
    }
    free(has_frame);
    return sound;
}

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void cross(const double *a, const double *b, double *c) {
    c[0] = a[1] * b[2] - a[2] * b[1], c[1] = a[2] * b[0] - a[0] * b[2], c[2] = a[0] * b[1] - a[1] * b[0];
}

/* C = A B */
static void product(const double *A, const double *B, double *C) {
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++) C[3 * r + c] = A[3 * r] * B[c] + A[3 * r + 1] * B[3 + c] + A[3 * r + 2] * B[6 + c];
}

/* C = A^T B */
static void transposed_product(const double *A, const double *B, double *C) {
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++) C[3 * r + c] = A[r] * B[c] + A[3 + r] * B[3 + c] + A[6 + r] * B[6 + c];
}

/* C = A B^T */
static void product_transposed(const double *A, const double *B, double *C) {
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++) C[3 * r + c] = dot(A + 3 * r, B + 3 * c);
}

static void apply(const double *A, const double *v, double *w) {
    for (int r = 0; r < 3; r++) w[r] = dot(A + 3 * r, v);
}

/* w = A^T v */
static void apply_transposed(const double *A, const double *v, double *w) {
    for (int r = 0; r < 3; r++) w[r] = A[r] * v[0] + A[3 + r] * v[1] + A[6 + r] * v[2];
}

/* Three angles of a relative rotation N in canonical axes: `_euler`. */
static void euler(const double *N, int proper, const double *signs, double *angles) {
    double a, b, c, rest;
    if (proper) { /* about x, y, x */
        rest = hypot(N[3], N[6]);
        a = atan2(N[3], -N[6]), b = atan2(rest, N[0]), c = atan2(N[1], N[2]);
        if (fabs(a) > FAR) a -= copysign(M_PI, a), b = -b, c -= copysign(M_PI, c);
        if (rest < GIMBAL) a = 0, c = atan2(N[7], N[4]);
    } else {
        rest = hypot(N[0], N[1]);
        a = atan2(-N[5], N[8]), b = atan2(N[2], rest), c = atan2(-N[1], N[0]);
        if (rest < GIMBAL) a = 0, c = atan2(N[3], N[4]);
    }
    angles[0] = a * signs[0], angles[1] = b * signs[1], angles[2] = c * signs[2];
}

/* The frame R that follows the measured directions, and its angles: `_free`. */
static void free_frame(const JointIndices *x, const JointConstants *k, const double *parent, const double *directions, double *R,
                       double *angles) {
    const double *v = directions + 3 * x->pair;
    double start[3], u[3], sum[3], first_e[3] = {0}, cosine = k->parent_weight, sine = 0;
    double length = sqrt(dot(v, v));
    apply(parent, k->first, start);
    for (int i = 0; i < 3; i++) u[i] = length < SMALL ? start[i] : v[i] / length, sum[i] = start[i] + u[i];
    double bend = 1 + dot(start, u);
    if (bend < SMALL) bend = SMALL;
    for (int s = 0; s < (x->others ? x->others : 1); s++) {
        double e[3], across[3], side[3];
        apply(parent, k->others[s], e);
        double share = dot(e, u) / bend;
        for (int i = 0; i < 3; i++) e[i] -= share * sum[i];
        if (!s)
            for (int i = 0; i < 3; i++) first_e[i] = e[i];
        if (s >= x->others) break;
        const double *w = directions + 3 * x->other_pairs[s];
        double along = dot(w, u), square = dot(w, w);
        for (int i = 0; i < 3; i++) across[i] = w[i] - along * u[i];
        if (square < SMALL * SMALL) square = SMALL * SMALL;
        double scale = sqrt(dot(across, across)) / square * k->weights[s];
        cross(u, e, side);
        double c = scale * dot(across, e), d = scale * dot(across, side);
        if (!s && fabs(atan2(d, c)) > k->max_twist) c = -c, d = -d;
        cosine += c, sine += d;
    }
    double size = sqrt(cosine * cosine + sine * sine), side[3], third[3];
    if (size > 0)
        cosine /= size, sine /= size;
    else if (size == 0) /* NaN stays */
        cosine = 1, sine = 0;
    cross(u, first_e, side);
    for (int i = 0; i < 3; i++) first_e[i] = cosine * first_e[i] + sine * side[i];
    cross(u, first_e, third);
    const double B[9] = {u[0], first_e[0], third[0], u[1], first_e[1], third[1], u[2], first_e[2], third[2]};
    product_transposed(B, k->basis, R);
    if (x->angles[0] < 0) return;
    double relative[9], N[9], turned[9];
    transposed_product(parent, R, relative);
    transposed_product(k->to_axes, relative, turned);
    product(turned, k->to_axes, N);
    euler(N, x->proper, k->signs, angles);
}

/* The frame R of a hinge or of an aimed joint, and its angles: `_hinge`, `_aimed` and `_rotation`. */
static void turned_frame(const JointIndices *x, const JointConstants *k, const double *parent, const double *v, double *R,
                         double *angles) {
    double local[3], w[3], M[9] = {0}, part[9], turned[9];
    apply_transposed(parent, v, local);
    apply_transposed(k->to_axes, local, w);
    double a = atan2(w[1], w[0]);
    angles[0] = a * k->signs[0];
    if (x->kind == HINGE_JOINT) {
        M[0] = M[4] = cos(a), M[3] = sin(a), M[1] = -M[3], M[8] = 1;
    } else {
        double b = k->elevation - atan2(w[2], hypot(w[0], w[1]));
        angles[1] = b * k->signs[1];
        double c1 = cos(a), s1 = sin(a), c2 = cos(b), s2 = sin(b);
        M[0] = c1 * c2, M[1] = -s1, M[2] = c1 * s2, M[3] = s1 * c2, M[4] = c1, M[5] = s1 * s2, M[6] = -s2, M[8] = c2;
    }
    product(k->to_axes, M, part);
    product_transposed(part, k->to_axes, turned);
    product(parent, turned, R);
}

void joint_frames(const JointTree *tree, ptrdiff_t n, const double *directions, double *rotations, double *angles) {
    static const double untouched[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
    for (ptrdiff_t o = 0; o < n; o++) {
        const double *d = directions + 3 * tree->m * o;
        double *R = rotations + 9 * tree->j * o, *theta = angles + tree->a * o;
        for (ptrdiff_t i = 0; i < tree->k; i++) {
            const JointIndices *x = tree->indices + i;
            const JointConstants *k = tree->constants + i;
            const double *parent = x->parent < 0 ? untouched : R + 9 * x->parent;
            double found[3] = {0};
            if (x->kind == FREE_JOINT)
                free_frame(x, k, parent, d, R + 9 * x->joint, found);
            else
                turned_frame(x, k, parent, d + 3 * x->pair, R + 9 * x->joint, found);
            for (int s = 0; s < 3; s++)
                if (x->angles[s] >= 0) theta[x->angles[s]] = found[s];
        }
    }
}

void rotations_to_quaternions(ptrdiff_t n, const double *rotations, double *quaternions) {
    for (ptrdiff_t o = 0; o < n; o++) {
        const double *R = rotations + 9 * o;
        double *q = quaternions + 4 * o, trace = R[0] + R[4] + R[8], x, y, z, w;
        /* The largest component is computed first: the others would lose digits near 0. */
        if (trace >= R[0] && trace >= R[4] && trace >= R[8])
            x = R[7] - R[5], y = R[2] - R[6], z = R[3] - R[1], w = 1 + trace;
        else if (R[0] >= R[4] && R[0] >= R[8])
            x = 1 + 2 * R[0] - trace, y = R[1] + R[3], z = R[6] + R[2], w = R[7] - R[5];
        else if (R[4] >= R[8])
            x = R[1] + R[3], y = 1 + 2 * R[4] - trace, z = R[5] + R[7], w = R[2] - R[6];
        else
            x = R[6] + R[2], y = R[5] + R[7], z = 1 + 2 * R[8] - trace, w = R[3] - R[1];
        double size = sqrt(x * x + y * y + z * z + w * w);
        size = w < 0 ? -size : size;
        q[0] = x / size, q[1] = y / size, q[2] = z / size, q[3] = w / size;
    }
}
