# SPDX-License-Identifier: Apache-2.0
"""HTML pages that open offline: reports of trainings, and recordings."""
