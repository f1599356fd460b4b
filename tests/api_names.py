#!/usr/bin/env python3
"""docs/api.md names everything that the API's headers declare, and nothing else; what uses the API includes no other header.

  tests/api_names.py [--list]

The headers are those that package/CMakeLists.txt calls `api`. Their names: structs, classes, enumerations, functions,
constants and types at namespace level. In docs/api.md they stand in backquotes in the row of their header.
"""
import pathlib
import re
import sys

ROOT = pathlib.Path(__file__).resolve().parent.parent
CMAKE = (ROOT / "package/CMakeLists.txt").read_text()
HEADERS = re.search(r"set\(api ([^)]*)\)", CMAKE)[1].split()


def names(text):
    text = re.sub(r"//[^\n]*|/\*.*?\*/|\"(?:[^\"\\\n]|\\.)*\"", "", text, flags=re.S)
    text = re.sub(r"^ *#(?:[^\n\\]|\\\n|\\)*$", "", text, flags=re.M)
    macros = set()
    # leave only what is at namespace level: bodies of functions, structs and initializers go
    depth, level, out = 0, [], []
    for token in re.finditer(r"namespace [\w:]* *\{|[{}]|[^{}]+?(?=[{}]|namespace |$)", text, re.S):
        t = token[0]
        if t.startswith("namespace"):
            level.append(True)
        elif t == "{":
            level.append(False)
            if level.count(False) == 1:
                out.append("{}")
        elif t == "}":
            if level.pop() is False and level.count(False) == 0:
                out.append("")
        elif False not in level:
            out.append(t)
    flat = "".join(out)
    found = set(macros)
    for statement in re.split(r";|(?<=\{\})", flat):
        s = " ".join(statement.split())
        if not s or s == "{}":
            continue
        if m := re.match(r"(?:template <[^>]*> )?(?:struct|class|enum class|enum) (\w+)(.*)", s):
            if "{}" in m[2]:  # a declaration alone is of another header
                found.add(m[1])
        elif m := re.match(r"using (\w+) =", s):
            found.add(m[1])
        elif m := re.match(r"(?:inline )?constexpr [\w:<>* ]+?(\w+)(?:\[\])? *(?:=|\{)(.*)", s):
            found.add(m[1])
            found.update(re.findall(r", (k[A-Z]\w+) =", m[2]))
        elif m := re.match(r"(?:\[\[\w+\]\] )?(?:inline |extern |const )*[\w:<>,&* ]+?[ &*](\w+)\(", s):
            found.add(m[1])
    return found


def rows():
    out = {}
    for line in (ROOT / "docs/api.md").read_text().split("\n"):
        if m := re.match(r"\| \[([\w/]+)\.h\]\([^)]*\) \|(.*)\|", line):
            out[m[1]] = set(re.findall(r"`(\w+)`", m[2]))
    return out


if sys.argv[1:] == ["--list"]:
    for header in HEADERS:
        print(header, " ".join(f"`{name}`" for name in sorted(names((ROOT / f"include/chainsplat/{header}.h").read_text()))))
    sys.exit()
faults, told = [], rows()
beneath = re.search(r"set\(beneath ([^)]*)\)", CMAKE)[1].split()
for folder in (*(f"include/chainsplat/{header}.h" for header in HEADERS + beneath), "python/src/*", "examples/*.cpp", "tests/package/cpp/*"):
    for file in ROOT.glob(folder):
        for header in re.findall(r'#include ["<]chainsplat/([\w/]+)\.h', file.read_text()):
            if header not in HEADERS + beneath:
                faults.append(f"{file.relative_to(ROOT)}: includes {header}.h, which is not installed")
for header in HEADERS:
    real = names((ROOT / f"include/chainsplat/{header}.h").read_text())
    if not real:
        faults.append(f"include/chainsplat/{header}.h: no names were found")
    for name in sorted(real - told.get(header, set())):
        faults.append(f"docs/api.md: {header}.h has `{name}`, which is not named")
    for name in sorted(told.get(header, set()) - real):
        faults.append(f"docs/api.md: {header}.h does not have `{name}`")
for header in sorted(set(told) - set(HEADERS)):
    faults.append(f"docs/api.md: {header}.h is no header of the API")
print("\n".join(faults + [f"{len(HEADERS)} headers, {sum(map(len, told.values()))} names, {len(faults)} faults"]))
sys.exit(bool(faults))
