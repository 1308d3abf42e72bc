"""The parts of `local/lab`: pinned tools, the one-node cluster, the AWS stand-in and images, on one Linux machine."""
