/* SPDX-License-Identifier: Apache-2.0 */
/* The formulas are those of lifting/steady_depth.py, which test/lifting/test_steady_depth.py compares. */
#include "steady_depth.h"

#include <math.h>

#include "geometry.h"

static const double NEAREST = 1e-6; /* steady_depth._NEAREST */

static double low_pass_gain(double cutoff, double seconds) { return 1 - 1 / (1 + 2 * M_PI * cutoff * seconds); }

static void restart(ptrdiff_t p, double *velocity, double *depths, double *points, const float *S) {
    for (ptrdiff_t i = 0; i < 3 * p; i++) points[i] = S[i], velocity[i] = 0;
    for (ptrdiff_t i = 0; i < p; i++) depths[i] = S[3 * i + 2];
}

/* Solve A x = b of a symmetric positive definite A, by its adjugate. */
static void solve(const double A[3][3], const double b[3], double x[3]) {
    double C[3][3], determinant = 0;
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++)
            C[r][c] = A[(r + 1) % 3][(c + 1) % 3] * A[(r + 2) % 3][(c + 2) % 3] -
                      A[(r + 1) % 3][(c + 2) % 3] * A[(r + 2) % 3][(c + 1) % 3];
    for (int c = 0; c < 3; c++) determinant += A[0][c] * C[0][c];
    for (int r = 0; r < 3; r++) x[r] = (C[0][r] * b[0] + C[1][r] * b[1] + C[2][r] * b[2]) / determinant;
}

/* Set R = Q R for the rotation Q of a rotation vector. */
static void turn(const double v[3], float *R) {
    double angle = sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), half = angle / 2;
    double by = angle > 1e-12 ? sin(half) / angle : 0.5;
    rotation Q;
    rotation_from_quaternion(by * v[0], by * v[1], by * v[2], cos(half), Q);
    for (int c = 0; c < 3; c++) {
        double column[3] = {R[c], R[3 + c], R[6 + c]};
        for (int r = 0; r < 3; r++) R[3 * r + c] = (float)(Q[r][0] * column[0] + Q[r][1] * column[1] + Q[r][2] * column[2]);
    }
}

static void steady(const DepthConstants *c, double time, ptrdiff_t p, double *state, float *S, float *R) {
    double *points = state + 1, *velocity = points + 3 * p, *depths = velocity + 3 * p, elapsed = time - state[0];
    if (!(elapsed >= -c->max_back && elapsed <= c->max_gap)) {
        state[0] = time;
        restart(p, velocity, depths, points, S);
        return;
    }
    if (!(elapsed > 0)) return;
    double mean[3] = {0}, squares = 0, speed = 0, gain = low_pass_gain(c->speed_cutoff, elapsed);
    for (ptrdiff_t i = 0; i < p; i++)
        for (int r = 0; r < 3; r++) mean[r] += S[3 * i + r] / (double)p;
    for (ptrdiff_t i = 0; i < 3 * p; i++) {
        double centred = S[i] - mean[i % 3];
        squares += centred * centred;
        velocity[i] += gain * ((S[i] - points[i]) / elapsed - velocity[i]);
        speed += velocity[i] * velocity[i];
        points[i] = S[i];
    }
    double radius = sqrt(squares / (double)p);
    speed = sqrt(speed / (double)p) / (radius > 0 ? radius : 1);
    gain = low_pass_gain(c->cutoff + c->beta * speed, elapsed);
    int in_front = 1;
    for (ptrdiff_t i = 0; i < p; i++) {
        depths[i] += gain * (S[3 * i + 2] - depths[i]);
        in_front = in_front && fmin(S[3 * i + 2], depths[i]) > NEAREST;
    }
    state[0] = time;
    double inertia[3][3] = {{0}}, moment[3] = {0}, vector[3];
    for (ptrdiff_t i = 0; i < p; i++) {
        float *s = S + 3 * i;
        double x[3], moved[3] = {0}, ratio = depths[i] / s[2];
        for (int r = 0; r < 3; r++) x[r] = s[r] - mean[r], moved[r] = in_front ? s[r] * ratio - s[r] : 0;
        if (!in_front) moved[2] = depths[i] - s[2];
        for (int r = 0; r < 3; r++) {
            int q = (r + 1) % 3, t = (r + 2) % 3;
            moment[r] += x[q] * moved[t] - x[t] * moved[q];
            for (int d = 0; d < 3; d++) inertia[r][d] -= x[r] * x[d];
        }
        for (int r = 0; r < 3; r++) s[r] = (float)(s[r] + moved[r]);
    }
    for (int r = 0; r < 3; r++) inertia[r][r] += (1 + 1e-6) * squares;
    if (!(squares > 0)) return;
    solve((const double(*)[3])inertia, moment, vector);
    turn(vector, R);
}

void steady_depths(const DepthConstants *c, double time, ptrdiff_t n, ptrdiff_t p, double *states, const int *rows, float *shapes,
                   float *rotations) {
    for (ptrdiff_t i = 0; i < n; i++) {
        int lifted = rows[i] >= 0;
        for (ptrdiff_t k = 0; lifted && k < 3 * p; k++) lifted = isfinite(shapes[3 * p * i + k]);
        if (lifted) steady(c, time, p, states + rows[i] * (1 + 7 * p), shapes + 3 * p * i, rotations + 9 * i);
    }
}
