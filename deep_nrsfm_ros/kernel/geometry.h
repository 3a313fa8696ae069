/* SPDX-License-Identifier: Apache-2.0 */
/* Geometry of one object: nrsfm/geometry.py. */
#ifndef GEOMETRY_H
#define GEOMETRY_H

typedef double camera[3][2];
typedef double rotation[3][3];

/* Of the visible keypoints W (p, 2) and P (p, 2): means (Wx, Wy, Px, Py), and sums of squares and products about
   them. */
typedef struct {
    double mean[4], WW, PP, WP, WxWx, WyWy, WxWy;
} Moments;

/* visible: (p), 1 or 0. The coordinates of P are P[0 ... p - 1] and P[P_stride ... P_stride + p - 1]. */
Moments moments(int p, const float *W, const float *P, int P_stride, const float *visible);
/* Return the scale of P that fits W best. */
double fitted_scale(Moments m);
/* Return the error of the scaled P, relative to the extent of W: 0 exact, 1 nothing explained. */
double reprojection_error(Moments m);
/* Return whether W lies on one line, which determines no camera. */
int on_one_line(Moments m);

/* Replace the columns of A (3, 2) by those of its orthonormal factor. */
void polar(camera A);
/* Set R, whose first two rows are the columns of M and the third their cross product. */
void rotation_from_camera(camera M, rotation R);
void transpose(rotation R, rotation out);
/* Set R to the rotation of a unit quaternion. */
void rotation_from_quaternion(double x, double y, double z, double w, rotation R);
/* Set out to the rotation about the same axis by `part` in [0, 1] of the angle of R; out may be R. */
void rotation_part(rotation R, double part, rotation out);

/* S (3, p) = A S for A (3, 3); rows of S are `stride` apart. */
void rotate(int p, int stride, rotation A, float *S);

#endif
