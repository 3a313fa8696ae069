/* geometry.py, for one object. */
#ifndef GEOMETRY_H
#define GEOMETRY_H

typedef double camera[3][2];
typedef double rotation[3][3];

/* Of points W (p, 2) and P (p, 2): means of both, and sums of squares and products about them. */
typedef struct {
    double mean[4], WW, PP, WP, WxWx, WyWy, WxWy;
} Moments;

/* Of the visible; the coordinates of P are P[0 ... p - 1] and P[apart ... apart + p - 1]. */
Moments moments(int p, const float *W, const float *P, int apart, const float *visible);
double fitted_scale(Moments m);
double reprojection_error(Moments m);
int on_one_line(Moments m);

/* Replace the columns of A (3, 2) by those of its orthonormal factor. */
void polar(camera A);
void rotation_from_camera(camera M, rotation R);
void transpose(rotation R, rotation out);

/* S (3, p) = A S for A (3, 3); rows are `wide` apart. */
void rotate(int p, int wide, rotation A, float *S);

#endif
