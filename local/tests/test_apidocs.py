"""The pages of the API: what they show of a definition, how its file is read, and that they are those of crds/."""

import re
import tempfile
import unittest
from pathlib import Path
from typing import Any

from labkit import apidocs, crdyaml
from labkit.errors import LabError

REPOSITORY = Path(__file__).resolve().parents[2]
TEXT = """\
# A comment.
names:
  short:
  - lb
  - "a: b"
rules:
- message: >-
    one line
    and more
  when: |-
    first

      second
- message: "\\"quoted\\""
  number: -3
on: true
empty: {}
nothing:
last: 1.5
"""


class Reading(unittest.TestCase):
    def test_the_forms_that_are_printed_are_read(self) -> None:
        self.assertEqual(
            crdyaml.read(TEXT, "some.yaml"),
            {
                "names": {"short": ["lb", "a: b"]},
                "rules": [
                    {"message": "one line and more", "when": "first\n\n  second"},
                    {"message": '"quoted"', "number": -3},
                ],
                "on": True,
                "empty": {},
                "nothing": None,
                "last": 1.5,
            },
        )

    def test_any_other_form_is_an_error_with_its_line(self) -> None:
        others = ("a: [1, 2]", "a: 'b'", "a: >\n  b", "a: &b c", "a: b: c", "a: b\n   c", "a b", "a: b # c", 'a: "b')
        for other in others:
            with self.subTest(other), self.assertRaisesRegex(LabError, r"some\.yaml:[23]"):
                crdyaml.read(f"first: 1\n{other}\n", "some.yaml")


def field(**more: Any) -> dict[str, Any]:
    return {"description": "A text", "type": "string", **more}


def part(properties: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"description": "A part.", "type": "object", "properties": properties, **more}


class Sections(unittest.TestCase):
    def rows(self, properties: dict[str, Any], path: str = "spec", **more: Any) -> list[str]:
        return list(apidocs.sections(part(properties, **more), path, 2))

    def row(self, schema: dict[str, Any]) -> str:
        return next(line for line in self.rows({"a": schema}) if line.startswith("| `a`"))

    def test_a_row_shows_type_default_and_limits(self) -> None:
        for schema, shown in (
            (field(default="x", enum=["x", None]), "string | `x` | A text. One of `x`."),
            (field(type="integer", default=0, minimum=0), "integer | `0` | A text. At least 0."),
            (field(type="integer", minimum=1, maximum=9), "integer |  | A text. 1 to 9."),
            (field(type="boolean", default=False), "boolean | `false` | A text."),
            (field(default="", maxLength=3), 'string | `""` | A text. At most 3 characters.'),
            (field(pattern="^(a|b)$"), "string |  | A text. Pattern `^(a\\|b)$`."),
            (field(format="date-time"), "time |  | A text."),
            (field(description="`<a>` is\n\n<b> | *c*"), "string |  | `<a>` is &lt;b> \\| \\*c\\*."),
            (
                field(type="array", maxItems=2, items={"type": "string", "maxLength": 3}),
                "list of string |  | A text. At most 2 entries. Each: at most 3 characters.",
            ),
            (
                field(type="object", additionalProperties={"type": "string"}, default={}),
                "map of string | `{}` | A text.",
            ),
            ({"description": "A text", "x-kubernetes-int-or-string": True}, "integer or string |  | A text."),
        ):
            self.assertEqual(self.row(schema), f"| `a` | {shown} |")

    def test_required_is_what_a_person_has_to_write(self) -> None:
        self.assertIn("| `a` | string | required | A text. |", self.rows({"a": field()}, required=["a"]))
        self.assertIn("| `a` | string |  | A text. |", self.rows({"a": field()}, path="status", required=["a"]))

    def test_an_object_has_a_section_with_its_rules_and_a_link_to_it(self) -> None:
        rule = {"x-kubernetes-validations": [{"rule": "false", "message": "a|b is wrong;\n write c"}]}
        lines = self.rows({"some": field(items=part({"b": field()}, **rule), type="array")})
        self.assertIn("| `some` | list of [object](#specsome) |  | A text. |", lines)
        heading = lines.index("### spec.some[]")
        self.assertEqual(lines[heading + 4 : heading + 7], [*lines[5:7], "| `b` | string |  | A text. |"])
        self.assertEqual(lines[-1], "- a\\|b is wrong; write c")

    def test_what_kubernetes_defines_is_named_and_not_shown(self) -> None:
        toleration = part({"effect": {}, "operator": {}, "tolerationSeconds": {}, "key": {}})
        lines = self.rows({"a": field(type="array", items=toleration)})
        self.assertIn("| `a` | list of `Toleration` of Kubernetes |  | A text. |", lines)
        self.assertEqual([line for line in lines if line.startswith("#")], ["## spec"])

    def test_a_text_that_no_cell_holds_goes_on_below_the_table(self) -> None:
        sentences = [f"{'word ' * 20}`code. {number}`." for number in range(3)]
        lines = self.rows({"a": field(description=" ".join(sentences), enum=["x"]), "b": field()})
        self.assertIn(f"| `a` | string |  | {sentences[0]} See below. |", lines)
        self.assertEqual(lines[-4:], ["", "More of these fields:", "", f"- `a`: {' '.join(sentences[1:])} One of `x`."])

    def test_a_field_without_a_text_of_its_own_is_an_error(self) -> None:
        for schema in ({"type": "string"}, field(description=f"{apidocs.FOREIGN} which supports")):
            with self.assertRaisesRegex(LabError, r"spec\.a has no text"):
                self.row(schema)


class Pages(unittest.TestCase):
    def test_they_are_those_of_the_definitions(self) -> None:
        apidocs.same(REPOSITORY)

    def test_each_field_of_the_definitions_is_in_them(self) -> None:
        """Counted another way than the pages are made: by the lines of the files."""
        for name in ("leaderboards", "submissions"):
            source = (REPOSITORY / "crds" / f"{name}.yaml").read_text()
            _, spec, status = re.split(r"^          (?:spec|status):$", source, flags=re.MULTILINE)
            page = (REPOSITORY / apidocs.FOLDER / f"{name.removesuffix('s')}.md").read_text()
            for part_of_page, text in (("spec", spec), ("status", status)):
                section = page.partition(f"\n## {part_of_page}\n")[2].partition("\n### ")[0]
                names = re.findall(r"^              ([a-zA-Z]\w*):$", text, re.MULTILINE)
                self.assertGreater(len(names), 5)
                self.assertEqual(re.findall(r"^\| `(\w+)` ", section, re.MULTILINE), names)

    def test_every_link_of_a_page_has_its_section(self) -> None:
        for file, text in apidocs.files(REPOSITORY):
            headings = {apidocs.anchor(heading) for heading in re.findall(r"^#+ (.+)$", text, re.MULTILINE)}
            links = set(re.findall(r"\]\(#([^)]+)\)", text))
            self.assertGreater(len(links), 5, file)
            self.assertEqual(links - headings, set(), file)

    def test_a_stale_page_is_an_error(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder)
            (copy / "crds").symlink_to(REPOSITORY / "crds")
            (copy / "docs").mkdir()
            apidocs.update(copy)
            apidocs.same(copy)
            page = copy / apidocs.FOLDER / "submission.md"
            page.write_text(page.read_text().replace("| `1` |", "| `2` |", 1))
            with self.assertRaisesRegex(LabError, "make chart-docs"):
                apidocs.same(copy)


if __name__ == "__main__":
    unittest.main()
