# SPDX-License-Identifier: Apache-2.0
"""Classic factorisations of images of one object into cameras and shapes, without a network."""
