# SPDX-License-Identifier: Apache-2.0
"""The ROS side: messages in and out, parameters, and the job that trains."""
