/* SPDX-License-Identifier: Apache-2.0 */
/* The lift of a block of objects: NumpyBackend of lifting/numpy_backend.py in C.

   In NumPy a lift is some four hundred small calls, which cost ten times what they compute. What is computed of
   an object does not depend on the others of its block. */
#include <math.h>
#include <string.h>

#include "plan.h"

/* Rotate a shape S (3, stride) of the network from its axes to camera axes, and set its camera M for the input
   before rotation t and mirroring. */
static void to_camera_axes(Plan *k, int t, int mirrored, float *S, camera M) {
    int p = k->p, stride = k->stride;
    const double *T = k->image_rotations + 4 * t;
    rotation A, R;
    camera framed = {{0}};
    for (int i = 0; i < 9; i++) A[i % 3][i / 3] = k->object_frame[i]; /* transposed, as S is */
    rotate(p, stride, A, S);
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 2; c++) {
            for (int q = 0; q < 3; q++) framed[r][c] += A[r][q] * M[q][c];
            if (mirrored) framed[r][c] *= (r == 1 ? -1 : 1) * (c == 0 ? -1 : 1);
        }
    for (int r = 0; r < 3 && mirrored; r++) {
        for (int i = 0; i < p; i++) k->V[i] = (r == 1 ? -1 : 1) * S[r * stride + k->partners[i]];
        memcpy(S + r * stride, k->V, p * sizeof(float));
    }
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 2; c++) M[r][c] = framed[r][0] * T[c] + framed[r][1] * T[2 + c];
    rotation_from_camera(M, R);
    rotate(p, stride, R, S);
}

/* Return the relative reprojection error of S (3, stride), in camera axes, against the visible of W. */
static double residual_of(Plan *k, const Object *o, int perspective, const float *S) {
    int p = k->p, stride = k->stride;
    float *P = k->V;
    if (!perspective) return reprojection_error(moments(p, o->W, S, stride, o->visible));
    for (int i = 0; i < p; i++) {
        float depth = (float)fmax((float)(1 + o->unit * S[2 * stride + i]), k->min_relative_depth);
        P[i] = S[i] / depth, P[stride + i] = S[stride + i] / depth;
    }
    return reprojection_error(moments(p, o->W, P, stride, o->visible));
}

void average_rotations(Plan *k, int n, Object *const *objects, int perspective) {
    int stride = k->stride, size = 3 * stride, t = k->rotations, all = t * (1 + k->mirrored);
    for (int mirrored = 0; mirrored <= k->mirrored; mirrored++)
        forward(k, n, objects, mirrored, k->shapes + (size_t)mirrored * n * t * size,
                (camera *)k->cameras + mirrored * n * t);
    for (int i = 0; i < n; i++) {
        Object *o = objects[i];
        double least = INFINITY, sum = 0;
        for (int rotation = 0; rotation < all; rotation++) {
            int at = (rotation / t * n + i) * t + rotation % t;
            float *S = k->shapes + (size_t)at * size;
            to_camera_axes(k, rotation % t, rotation >= t, S, ((camera *)k->cameras)[at]);
            k->residuals[rotation] = residual_of(k, o, perspective, S);
            least = fmin(least, k->residuals[rotation]);
        }
        memset(o->S, 0, size * sizeof(float));
        memset(o->M, 0, sizeof(camera));
        o->residual = 0;
        for (int rotation = 0; rotation < all; rotation++)
            sum += exp((least * least - k->residuals[rotation] * k->residuals[rotation]) / k->residual_scale);
        for (int rotation = 0; rotation < all; rotation++) {
            int at = (rotation / t * n + i) * t + rotation % t;
            const float *S = k->shapes + (size_t)at * size;
            double r = k->residuals[rotation];
            double weight = exp((least * least - r * r) / k->residual_scale) / sum;
            o->residual += weight * r;
            for (int j = 0; j < size; j++) o->S[j] += (float)weight * S[j];
            for (int j = 0; j < 6; j++) o->M[j / 2][j % 2] += weight * k->cameras[6 * at + j];
        }
        polar(o->M);
    }
}

/* Set S, in camera axes, and R of n objects from their inputs. */
static void fit_block(Plan *k, int n, Object *const *objects, int perspective) {
    int p = k->p, apart = DOUBLES_OF(p);
    for (int i = 0; i < n; i++) normalise(k, objects[i]);
    average_rotations(k, n, objects, perspective);
    for (int i = 0; i < n; i++)
        if (objects[i]->first && k->leave_out_wrong) leave_out_wrong(k, objects[i], perspective);
    for (int j = 0; j < n; j++) {
        Object *o = objects[j];
        double square = 0;
        rotation back;
        rotation_from_camera(o->M, o->R);
        if (!k->corrected) continue;
        transpose(o->R, back);
        rotate(p, k->stride, back, o->S);
        if (o->last && o->updates) smooth_network(k, o);
        for (int i = 0; i < p; i++) {
            int doubtful = o->weight[i] > 0 && !o->visible[i];
            for (int c = 0; c < 2; c++) {
                const float *image = doubtful ? o->image_points : o->input;
                if (doubtful) o->W[2 * i + c] = (float)((image[2 * i + c] - o->origin[c]) / o->unit);
                double along = perspective ? image[2 * i + c] : 0, w = o->W[2 * i + c];
                for (int r = 0; r < 3; r++)
                    k->point_cameras[(2 * r + c) * apart + i] = o->M[r][c] - o->R[2][r] * along;
                square += o->visible[i] * w * w;
            }
        }
        correct(k, o, k->noise * sqrt(square / fmax(2 * o->visible_count, 1)));
        rotate(p, k->stride, o->R, o->S);
    }
}

/* Set the input to the image points, and where these are not visible to the projection of S into the image. */
static void refill_input(Plan *k, Object *o, int perspective) {
    int p = k->p, stride = k->stride;
    for (int i = 0; i < p; i++) {
        o->input_mask[i] = 1;
        for (int c = 0; c < 2; c++) {
            double at = o->unit * o->S[c * stride + i] + o->origin[c];
            if (perspective) at /= fmax(1 + o->unit * o->S[2 * stride + i], k->min_relative_depth);
            o->input[2 * i + c] = o->visible[i] ? o->image_points[2 * i + c] : (float)at;
        }
    }
}

/* Set the gap of the missing keypoints, `gaps` of lifting/confidence.py; return the known fraction of the variance of
   all keypoints. The diagonal of the inverse of U^T U is the squared length of the columns of U^-T. */
static double set_gaps(Plan *k, const Object *o) {
    int p = k->p, m = 0, *missing = k->missing;
    double unknown = 0, *y = k->spread;
    for (int i = 0; i < p; i++)
        if (!o->visible[i]) missing[m++] = i;
    if (!m) return 1;
    int n = DOUBLES_OF(m), stride = n + DOUBLES;
    memset(k->system, 0, (size_t)n * stride * sizeof(double));
    for (int a = 0; a < n; a++) {
        double *row = k->system + (size_t)a * stride;
        if (a >= m) row[a] = 1;
        for (int b = a; b < m; b++) row[b] = k->point_precision[(size_t)missing[a] * p + missing[b]];
    }
    solve(n, 0, stride, k->system);
    for (int a = 0; a < m; a++) {
        double square = 0;
        for (int b = a; b < m; b++) y[b] = b == a;
        for (int b = a; b < m; b++) {
            const double *U = k->system + (size_t)b * stride;
            y[b] /= U[b];
            square += y[b] * y[b];
            for (int c = b + 1; c < m; c++) y[c] -= U[c] * y[b];
        }
        k->gap[missing[a]] = sqrt(square);
        unknown += square / p;
    }
    return fmax(1 - unknown, k->min_known);
}

/* Set the confidence (p): the chance that each keypoint of a shape of this RMS radius is near its true place.

   As keypoint_confidence of lifting/confidence.py. */
static void set_confidence(Plan *k, const Object *o, double radius, float *confidence) {
    const double *seen = k->calibration, *hidden = seen + COEFFICIENTS;
    int p = k->p, stride = k->stride;
    double count = fmax(o->visible_count, 1), centroid[3] = {0}, extent = 0;
    radius = fmax(radius, 1e-9);
    for (int r = 0; r < 3; r++) {
        for (int i = 0; i < p; i++) centroid[r] += o->visible[i] * o->S[r * stride + i];
        centroid[r] /= count;
    }
    double *distance = k->spread;
    double explained = set_gaps(k, o); /* before the distances, which take the place of its scratch memory */
    for (int i = 0; i < p; i++) {
        double square = 0;
        for (int r = 0; r < 3; r++) {
            double offset = (o->S[r * stride + i] - centroid[r]) / radius;
            square += offset * offset;
        }
        extent += o->visible[i] * square / count;
        distance[i] = sqrt(square);
    }
    double log_residual = log(o->residual + k->residual_offset), log_radius = log(radius);
    double log_extent = log(sqrt(extent) + k->extent_offset);
    double common = seen[0] - seen[1] * log_radius + seen[2] * log_residual + seen[3] * log(count / p) +
                    seen[4] * log_extent;
    double common_hidden = hidden[0] - hidden[1] * log_radius + hidden[2] * log_residual +
                           hidden[3] * log(explained) + hidden[4] * log_extent;
    for (int i = 0; i < p; i++) {
        double detected = o->visible[i] ? o->certainty[i] : 0, log_std = k->log_error_std[i], chance = 0;
        if (detected > 0) chance = detected / (1 + exp(-common - seen[1] * log_std - seen[5] * distance[i]));
        if (detected < 1) {
            double gap = o->visible[i] ? 1 / sqrt(k->point_precision[(size_t)i * p + i]) : k->gap[i];
            chance += (1 - detected) / (1 + exp(-common_hidden - hidden[1] * log_std - hidden[5] * distance[i] -
                                                hidden[6] * gap));
        }
        confidence[i] = (float)chance;
    }
}

/* Return the number of visible keypoints, without those that follow from visible ones: `detected_count` of
   layouts/keypoint_map.py. */
static int detected_count(const Plan *k, const Object *o) {
    int n = (int)o->visible_count;
    for (int i = 0; i < k->derivations;) {
        const int keypoint = k->derivation_pairs[2 * i];
        int follows = o->visible[keypoint] > 0;
        for (; i < k->derivations && k->derivation_pairs[2 * i] == keypoint; i++)
            follows &= o->visible[k->derivation_pairs[2 * i + 1]] > 0;
        n -= follows;
    }
    return n;
}

int is_lifted(const Plan *k, const Object *o, int fewest) {
    return !on_one_line(moments(k->p, o->image_points, o->S, k->stride, o->visible)) &&
           detected_count(k, o) >= fewest;
}

/* Write a fitted object as row i of the outputs; return 1 if it is not lifted. */
static int write_lifted(Plan *k, Object *o, ptrdiff_t i, float *const outputs[6]) {
    int p = k->p, stride = k->stride;
    const int *pair = k->reference;
    double radius = 0, size = 0;
    for (int r = 0; r < 3; r++) {
        float *S = o->S + r * stride;
        double mean = 0;
        for (int j = 0; j < p; j++) mean += S[j];
        for (int j = 0; j < p; j++) {
            S[j] -= (float)(mean / p);
            radius += (double)S[j] * S[j] / p;
        }
        double apart = pair[0] < 0 ? 0 : S[pair[0]] - S[pair[1]];
        size += apart * apart;
    }
    radius = sqrt(radius), size = pair[0] < 0 ? radius : sqrt(size);
    set_confidence(k, o, radius, outputs[5] + i * p);
    float factor = (float)(k->reference_length / fmax(size, 1e-9));
    for (int j = 0; j < 3 * stride; j++) o->S[j] *= factor;
    for (int j = 0; j < 3 * p; j++) outputs[0][3 * i * p + j] = o->S[j % 3 * stride + j / 3];
    for (int j = 0; j < 9; j++) outputs[1][9 * i + j] = (float)o->R[j / 3][j % 3];
    Moments m = moments(p, o->image_points, o->S, stride, o->visible);
    double scale = fitted_scale(m);
    outputs[2][i] = (float)scale;
    for (int c = 0; c < 2; c++) outputs[3][2 * i + c] = (float)(m.mean[c] - scale * m.mean[2 + c]);
    outputs[4][i] = (float)o->residual;
    return on_one_line(m) || detected_count(k, o) < k->min_visible;
}

/* Set the weight, visible, input_mask and visible_count: lifting/weights.py. */
static void set_weights(const Plan *k, Object *o) {
    double sum = 0, square = 0;
    for (int i = 0; i < k->p; i++) {
        double c = fmin(o->confidence[i], 1);
        sum += c, square += c * c;
    }
    double usual = fmax(k->full_ratio * square / fmax(sum, 1e-30), 1e-30);
    o->visible_count = 0;
    for (int i = 0; i < k->p; i++) {
        double ratio = fmin(fmin(o->confidence[i], 1) / usual, 1), r = ratio * ratio;
        o->certainty[i] = ratio, o->weight[i] = r * r * r;
        o->visible_count += o->input_mask[i] = o->visible[i] = o->weight[i] >= k->trusted_weight;
    }
}

void lift(Plan *k, ptrdiff_t n, const float *points, const float *confidence, int perspective,
          const Context *context, float *const outputs[6], char *wrong, char *not_lifted) {
    int p = k->p;
    memset(wrong, 0, (size_t)n * p);
    for (ptrdiff_t start = 0; start < n; start += k->block) {
        int block = n - start < k->block ? (int)(n - start) : k->block, incomplete = 0;
        for (int i = 0; i < block; i++) {
            Object *o = k->incomplete[i] = k->objects + i;
            o->image_points = points + 2 * p * (start + i), o->confidence = confidence + p * (start + i);
            o->wrong = wrong + p * (start + i);
            memcpy(o->input, o->image_points, 2 * p * sizeof(float));
            set_weights(k, o);
            recall(k, o, context, start + i, context && is_lifted(k, o, k->min_visible));
            o->first = 1, o->last = !k->refill_rounds || o->visible_count >= p;
        }
        fit_block(k, block, k->incomplete, perspective);
        for (int i = 0; i < block; i++)
            if (k->objects[i].visible_count < p) k->incomplete[incomplete++] = k->objects + i;
        for (int round = 0; round < k->refill_rounds && incomplete; round++) {
            for (int i = 0; i < incomplete; i++) {
                refill_input(k, k->incomplete[i], perspective);
                k->incomplete[i]->first = 0, k->incomplete[i]->last = round == k->refill_rounds - 1;
            }
            fit_block(k, incomplete, k->incomplete, perspective);
        }
        for (int i = 0; i < block; i++)
            not_lifted[start + i] = (char)write_lifted(k, k->objects + i, start + i, outputs);
    }
}
