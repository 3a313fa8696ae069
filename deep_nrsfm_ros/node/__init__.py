"""The ROS side: messages in and out, parameters, and the job that trains."""
