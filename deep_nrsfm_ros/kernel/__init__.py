"""The compiled kernel: the network's passes, the correction and the decoding of messages in C."""
