# SPDX-License-Identifier: Apache-2.0
"""Words for what the judge says of a model: in files, status, reports and lists."""

BETTER, AS_GOOD, ALONE, DOUBTFUL = "better", "as_good", "alone", "doubtful"
UNKNOWN = "unknown"
"""As good: both fit the held-out frames alike; alone: no other model has these keypoints; unknown:
the other model was trained on the held-out frames, and fits them better."""
