"""Makes the data from Python's own table of characters: a name is what an agent sees, the category is what it has to find."""
import csv, hashlib, sys
from pathlib import Path
from unicodedata import ucd_3_2_0 as table  # the same in every Python

CATEGORIES, TESTS, ALL = ("Ll", "Lo", "Lu", "Sm", "So"), 200, 1000
found = [(table.name(one), table.category(one)) for one in map(chr, range(0x20, 0x3000)) if table.category(one) in CATEGORIES]
found.sort(key=lambda row: hashlib.sha256(row[0].encode()).digest())  # shuffled, and the same each time
tests = [(number, *row) for number, row in enumerate(found[:TESTS])]

def write(file, head, rows):
    path = Path(sys.argv[1], file)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as text:
        csv.writer(text).writerows([head, *rows])

write("dataset/train.csv", ("name", "category"), found[TESTS:ALL])
write("dataset/test.csv", ("id", "name"), [(number, name) for number, name, _ in tests])
write("labels/labels.csv", ("id", "category"), [(number, category) for number, _, category in tests])
