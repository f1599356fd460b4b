#!/usr/bin/env python3
"""What the sources say of the documents, and the documents of the sources, is there.

  tests/docs_test.py [ROOT]

- A comment cites a section by its number, `mathematics.md 3.3`, or by its heading, `design.md, 'Recognition'`.
- A path in backticks in README.md and docs/ that begins with a folder of the repository exists; a name behind it in
  backticks of its own, `src/dynamics/engine.cpp` `mass_matrix`, stands in that file.
- A link to a file of the repository leads to one, and its #anchor to a heading.
- Nothing cites notes that are not in the repository.
"""
import pathlib
import re
import subprocess
import sys

ROOT = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else __file__).resolve()
ROOT = ROOT if ROOT.is_dir() else ROOT.parent.parent
FOLDERS = "src include shaders tools tests docs assets examples benchmarks python".split()
FOREIGN = re.compile(r"\b(SPEC|ERRATA|DYNAMICS_FIGURES|HOUSE_STYLE|ECOSYSTEM|PEERS)\b|\bDESIGN(,| \()|\bINTERFACE \d|\.\./shared")
faults = []


def files():
    listed = subprocess.run(["git", "-C", ROOT, "ls-files", "-co", "--exclude-standard"], capture_output=True, text=True)
    names = listed.stdout.split("\n") if listed.returncode == 0 else [str(p.relative_to(ROOT)) for p in ROOT.rglob("*")]
    for name in names:
        path = ROOT / name
        if name.startswith("tests/fuzz/c") or not path.is_file() or path.stat().st_size > 1 << 20:
            continue
        try:
            yield name, path.read_text()
        except UnicodeDecodeError:
            pass


def anchor(heading):
    text = re.sub(r"[`*]", "", heading.strip().lower())
    return re.sub(r"[^\w\- ]", "", text).replace(" ", "-")


headings = {}
documents = sorted(ROOT.glob("docs/*.md")) + [ROOT / "README.md"]
for path in documents:
    body = re.sub(r"^```.*?^```", "", path.read_text(), flags=re.M | re.S)
    headings[path.name] = re.findall(r"^#{1,6} +(.*?) *$", body, re.M)


def has_section(document, number):
    return any(re.match(re.escape(number) + r"[. ]", heading + " ") for heading in headings[document])


def has_heading(document, title):
    return any(re.sub(r"^[\d.]+ +", "", heading).startswith(title) for heading in headings[document])


cited = 0
for name, text in files():
    if name == "tests/docs_test.py":
        continue
    # a citation may be broken over two lines of a comment
    joined = re.sub(r"\n\s*(//|#|\*)?\s*", " ", text)
    for match in re.finditer(r"\b(\w+\.md),? (?:section )?(\d+(?:\.\d+)*|'[^']{3,80}')", joined):
        document, place = match[1], match[2]
        if document not in headings:
            continue
        cited += 1
        if place[0] == "'" and not has_heading(document, place.strip("'")) or place[0] != "'" and not has_section(document, place):
            faults.append(f"{name}: cites '{match[0]}', which docs/{document} does not have")
    for number, line in enumerate(text.split("\n"), 1):
        if found := FOREIGN.search(line):
            faults.append(f"{name}:{number}: cites '{found[0]}', which is not in the repository")

known = set()
for path in documents:
    text = path.read_text()
    name = path.relative_to(ROOT)
    for match in re.finditer(r"`((?:%s)/[\w./-]+)`(?: `([\w:~]+)(?:\(\))?`)?" % "|".join(FOLDERS), text):
        target = ROOT / match[1]
        known.add(match[1])
        if not target.exists():
            faults.append(f"{name}: names `{match[1]}`, which does not exist")
        elif match[2] and target.is_file() and match[2].split("::")[-1] not in target.read_text(errors="replace"):
            faults.append(f"{name}: says that `{match[1]}` has `{match[2]}`, which it has not")
    for match in re.finditer(r"\]\((?!\w+:)([^)#\s]*)(#[^)\s]+)?\)", text):
        target = path if not match[1] else (path.parent / match[1])
        if not target.exists():
            faults.append(f"{name}: links to {match[1]}, which does not exist")
        elif match[2] and target.name in headings and match[2][1:] not in map(anchor, headings[target.name]):
            faults.append(f"{name}: links to {match[1]}{match[2]}, which is no heading")

for fault in faults:
    print(fault)
print(f"{cited} citations, {len(known)} paths, {len(faults)} faults")
sys.exit(1 if faults or cited == 0 else 0)
