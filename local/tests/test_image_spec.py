"""The format of image files: what is taken, and what is refused with which words."""

import unittest

from labkit.errors import LabError
from labkit.image_spec import DirSpec, FileSpec, LinkSpec, parse

WHOLE = """
[[image]]
repository = "challenge/agent"
tag = "standard"
files = [
  {from = "bin:challenge-agent", to = "/usr/bin/python3", mode = "0755"},
  {from = "host:/bin/bash", to = "/bin/bash", libs = true},
  {from = "repo:local/challenge/contents", to = "/workspace", uid = 1000, gid = 1000},
  {from = "text:export A=1: yes", to = "/root/.bashrc"},
  {from = "made:examples/data.py labels", to = "/labels"},
]
symlinks = [{to = "/bin/sh", target = "/bin/bash"}]
dirs = [{path = "/tmp", mode = "1777"}, {path = "/root"}]
env = {B = "2", A = "1"}
entrypoint = ["/bin/bash"]
cmd = ["-c", "true"]
user = "1000:1000"
workdir = "/root"

[[image]]
repository = "challenge/agent"
tag = "other"
"""


def image(line: str) -> str:
    return f'[[image]]\nrepository = "a"\ntag = "1"\n{line}\n'


class Taken(unittest.TestCase):
    def test_every_key(self) -> None:
        first, second = parse(WHOLE, "images.toml")
        self.assertEqual(first.name, "challenge/agent:standard")
        self.assertEqual(
            first.files,
            (
                FileSpec("bin", "challenge-agent", "/usr/bin/python3", 0o755, False, 0, 0),
                FileSpec("host", "/bin/bash", "/bin/bash", None, True, 0, 0),
                FileSpec("repo", "local/challenge/contents", "/workspace", None, False, 1000, 1000),
                FileSpec("text", "export A=1: yes", "/root/.bashrc", None, False, 0, 0),
                FileSpec("made", "examples/data.py labels", "/labels", None, False, 0, 0),
            ),
        )
        self.assertEqual(first.symlinks, (LinkSpec("/bin/sh", "/bin/bash"),))
        self.assertEqual(first.dirs, (DirSpec("/tmp", 0o1777, 0, 0), DirSpec("/root", 0o755, 0, 0)))
        self.assertEqual(list(first.env), ["A", "B"])
        self.assertEqual((first.entrypoint, first.cmd), (("/bin/bash",), ("-c", "true")))
        self.assertEqual((first.user, first.workdir), ("1000:1000", "/root"))
        self.assertEqual((second.files, second.env, second.user), ((), {}, ""))


class Refused(unittest.TestCase):
    def test_each_mistake_is_named_with_its_place(self) -> None:
        cases = {
            "[[image": "f is not TOML",
            "": "f has no [[image]]",
            "image = 1": "f: image must be a list of tables",
            '[[image]]\nrepository = "A b"\ntag = "1"': "f: image 1: A b:1 is no image name",
            '[[image]]\nrepository = "a"': "f: image 1: tag must be a text",
            image("colour = 1"): "f: image 1 (a:1): nothing is called colour",
            image("env = {A = 1}"): "f: image 1 (a:1): env: A must be a text",
            image('cmd = "sh"'): "f: image 1 (a:1): cmd must be a list of texts",
            image('files = [{from = "bash", to = "/b"}]'): "file 1: from must begin with one of",
            image('files = [{from = "host:bash", to = "/b"}]'): "file 1: host: takes an absolute path",
            image('files = [{from = "repo:../x", to = "/b"}]'): "file 1: repo: takes a path inside the repository",
            image('files = [{from = "text:x", to = "b"}]'): "file 1: to = 'b' must be an absolute path",
            image('files = [{from = "text:x", to = "/a/../b"}]'): "must be an absolute path",
            image(
                'files = [{from = "text:x", to = "/b", mode = "0899"}]'
            ): "mode = '0899' must be three or four octal digits",
            image('files = [{from = "text:x", to = "/b", libs = "yes"}]'): "libs must be true or false",
            image('dirs = [{path = "/b", uid = -1}]'): "dir 1: uid must be a number from 0 on",
            image("") + image(""): "f has a:1 twice",
        }
        for text, words in cases.items():
            with self.subTest(words):
                with self.assertRaises(LabError) as caught:
                    parse(text, "f")
                self.assertIn(words, str(caught.exception))


if __name__ == "__main__":
    unittest.main()
