# SPDX-License-Identifier: Apache-2.0
"""Deep NRSfM (Kong & Lucey 2019, arXiv 1902.10840): the method, in torch and numpy, never ROS.

Legend: the paper's symbols, as the code names and stores them. `...` is any batch shape.

===========  ==================  ========================================================
paper        stored as           meaning
===========  ==================  ========================================================
W            W (..., p, 2)       2D keypoints, centred; p points
S, s         S (..., p, 3)       3D shape, and its vectorisation
M            M (..., 3, 2)       weak-perspective camera, M^T M = I; M^T is the first two
                                 rows of the rotation R from object to camera
D_1          D[0] (p, 3, k_1)    first dictionary; D[0][i, r, j] is the entry (3i + r, j) of
                                 the 3p x k_1 form and (i, 3j + r) of the p x 3k_1 form
D_i          D[i-1] (k_i-1, k_i) i-th dictionary, shared by encoder and decoder
Psi_i        Psi (..., 2, 3, k)  i-th block code: k blocks M psi_j, stored transposed (2 x 3)
                                 with the atoms last, so that a layer is one matrix product
psi_i        psi (..., k)        i-th code
b_i, b'_i    b[i-1], b_[i]       thresholds of the encoder (a block each), decoder's own
             code_head           psi_n from the entries of Psi_n ("Code and camera recovery")
             camera_head         M from the blocks of Psi_n
             L, L_inverse (p, p) whitening of the points, ours: the dictionaries are of L S
===========  ==================  ========================================================
"""
