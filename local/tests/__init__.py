"""Tests of the lab's parts that need neither root nor network: `python3 -m unittest discover -s local/tests -t local`."""
