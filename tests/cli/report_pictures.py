#!/usr/bin/env python3
"""Compares the pictures that a page has drawn (report_driver.js) with frames of `render --mask`.

  report_pictures.py DOM FRAMES LEAST LEAST_INSIDE    pictures in the dumped document against FRAMES/CAMERA/NNNNNN.png
  report_pictures.py A.png B.png LEAST                two files

Prints one line a picture with the PSNR of the whole image, and inside the mask, in dB. Exit code 1 where one is less.
"""
import base64
import math
import re
import struct
import sys
import zlib


def read_png(data):
    """Rows of 8-bit samples and the number of channels."""
    place, packed = 8, b""
    while place < len(data):
        size, kind = struct.unpack(">I4s", data[place:place + 8])
        body = data[place + 8:place + 8 + size]
        if kind == b"IHDR":
            width, height, depth, color = struct.unpack(">IIBB", body[:10])
            assert depth == 8 and body[12] == 0, "8 bits, not interlaced"
            channels = {0: 1, 2: 3, 4: 2, 6: 4}[color]
        elif kind == b"IDAT":
            packed += body
        place += 12 + size
    raw, stride, rows = zlib.decompress(packed), width * channels, []
    before = bytearray(stride)
    for y in range(height):
        start = y * (stride + 1)
        kind, line = raw[start], bytearray(raw[start + 1:start + 1 + stride])
        for i in range(stride):
            left = line[i - channels] if i >= channels else 0
            above, corner = before[i], before[i - channels] if i >= channels else 0
            if kind == 1:
                line[i] = (line[i] + left) & 255
            elif kind == 2:
                line[i] = (line[i] + above) & 255
            elif kind == 3:
                line[i] = (line[i] + (left + above) // 2) & 255
            elif kind == 4:
                a, b, c = abs(above - corner), abs(left - corner), abs(left + above - 2 * corner)
                line[i] = (line[i] + (left if a <= b and a <= c else above if b <= c else corner)) & 255
        rows.append(line)
        before = line
    return rows, channels


def psnr(one, other, mask=None):
    (a, a_channels), (b, b_channels) = one, other
    assert len(a) == len(b) and len(a[0]) // a_channels == len(b[0]) // b_channels, "sizes differ"
    total = count = 0
    for y, (p, q) in enumerate(zip(a, b)):
        for x in range(len(p) // a_channels):
            if mask and mask[0][y][x] < 128:
                continue
            count += 3
            for c in range(3):
                total += (p[a_channels * x + c] - q[b_channels * x + c]) ** 2
    return 100.0 if total == 0 else 10 * math.log10(255 ** 2 * count / total)


def load(path):
    with open(path, "rb") as file:
        return read_png(file.read())


bad = 0
if len(sys.argv) == 4:
    value = psnr(load(sys.argv[1]), load(sys.argv[2]))
    print(f"{sys.argv[1]}: {value:.1f} dB")
    bad = value < float(sys.argv[3])
else:
    dom = open(sys.argv[1], encoding="utf-8").read()
    shots = re.findall(r'<i class="shot" hidden="" data-name="([^"]*)">data:image/png;base64,([^<]*)</i>', dom)
    for name, text in shots:
        drawn, mask = load(f"{sys.argv[2]}/{name}.png"), load(f"{sys.argv[2]}/{name}.mask.png")
        shown = read_png(base64.b64decode(text))
        whole, inside = psnr(shown, drawn), psnr(shown, drawn, mask)
        print(f"{name}: {whole:.1f} dB, inside the mask {inside:.1f} dB")
        bad |= whole < float(sys.argv[3]) or inside < float(sys.argv[4])
    bad |= not shots
sys.exit(int(bad))
