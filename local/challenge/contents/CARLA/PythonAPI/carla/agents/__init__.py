"""The CARLA Python API's place on PYTHONPATH: the stand-in evaluator only looks whether it is there."""
