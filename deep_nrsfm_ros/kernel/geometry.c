/* SPDX-License-Identifier: Apache-2.0 */
#include "geometry.h"

#include <math.h>
#include <string.h>

#define TINY 1e-12

void polar(camera A) {
    double G[2][2] = {{0}}, cross = 0;
    for (int i = 0; i < 2; i++)
        for (int j = 0; j < 2; j++)
            for (int r = 0; r < 3; r++) G[i][j] += A[r][i] * A[r][j];
    double trace = G[0][0] + G[1][1];
    for (int r = 0; r < 3; r++) {
        double c = A[(r + 1) % 3][0] * A[(r + 2) % 3][1] - A[(r + 2) % 3][0] * A[(r + 1) % 3][1];
        cross += c * c;
    }
    double s = sqrt(cross + TINY * trace * trace + 1e-36), size = s * sqrt(trace + 2 * s);
    for (int r = 0; r < 3; r++) {
        double a = A[r][0], b = A[r][1];
        A[r][0] = ((trace + s) * a - G[0][0] * a - G[0][1] * b) / size;
        A[r][1] = ((trace + s) * b - G[1][0] * a - G[1][1] * b) / size;
    }
}

void rotation_from_camera(camera M, rotation R) {
    for (int r = 0; r < 3; r++) {
        R[0][r] = M[r][0], R[1][r] = M[r][1];
        R[2][r] = M[(r + 1) % 3][0] * M[(r + 2) % 3][1] - M[(r + 2) % 3][0] * M[(r + 1) % 3][1];
    }
}

void transpose(rotation R, rotation out) {
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) out[i][j] = R[j][i];
}

void rotation_from_quaternion(double x, double y, double z, double w, rotation R) {
    rotation turned = {{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
                       {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
                       {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}};
    memcpy(R, turned, sizeof(turned));
}

void rotation_part(rotation R, double part, rotation out) {
    double trace = R[0][0] + R[1][1] + R[2][2], q[4]; /* a quaternion x, y, z, w: as `quaternion` of geometry.py */
    int i = R[1][1] > R[0][0] ? 1 : 0;
    if (R[2][2] > R[i][i]) i = 2;
    int j = (i + 1) % 3, k = (i + 2) % 3;
    if (trace >= R[i][i]) {
        for (int r = 0; r < 3; r++) q[r] = R[(r + 2) % 3][(r + 1) % 3] - R[(r + 1) % 3][(r + 2) % 3];
        q[3] = 1 + trace;
    } else {
        q[i] = 1 + 2 * R[i][i] - trace, q[j] = R[i][j] + R[j][i], q[k] = R[k][i] + R[i][k];
        q[3] = R[k][j] - R[j][k];
    }
    double sine = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2]), sign = q[3] < 0 ? -1 : 1;
    double half = part * atan2(sine, sign * q[3]), by = sine > TINY ? sign * sin(half) / sine : 0;
    rotation_from_quaternion(by * q[0], by * q[1], by * q[2], cos(half), out);
}

void rotate(int p, int stride, rotation A, float *S) {
    for (int i = 0; i < p; i++) {
        double x = S[i], y = S[stride + i], z = S[2 * stride + i];
        for (int r = 0; r < 3; r++)
            S[r * stride + i] = (float)(A[r][0] * x + A[r][1] * y + A[r][2] * z);
    }
}

Moments moments(int p, const float *W, const float *P, int P_stride, const float *visible) {
    Moments m = {{0}, 0, 0, 0, 0, 0, 0};
    double n = 0;
    for (int i = 0; i < p; i++) {
        n += visible[i];
        m.mean[0] += visible[i] * W[2 * i], m.mean[1] += visible[i] * W[2 * i + 1];
        m.mean[2] += visible[i] * P[i], m.mean[3] += visible[i] * P[P_stride + i];
    }
    for (int c = 0; c < 4; c++) m.mean[c] /= fmax(n, 1);
    for (int i = 0; i < p; i++) {
        double a = W[2 * i] - m.mean[0], b = W[2 * i + 1] - m.mean[1], v = visible[i];
        double c = P[i] - m.mean[2], d = P[P_stride + i] - m.mean[3];
        m.WxWx += v * a * a, m.WyWy += v * b * b, m.WxWy += v * a * b;
        m.PP += v * (c * c + d * d), m.WP += v * (a * c + b * d);
    }
    m.WW = m.WxWx + m.WyWy;
    return m;
}

double fitted_scale(Moments m) { return m.WP / fmax(m.PP, TINY); }

double reprojection_error(Moments m) {
    return sqrt(fmax(1 - fitted_scale(m) * m.WP / fmax(m.WW, TINY), 0));
}

int on_one_line(Moments m) {
    return m.WxWx * m.WyWy - m.WxWy * m.WxWy <= 1e-6 * m.WW * m.WW;
}
