"""Reads MCAP files of messages in Protocol Buffers, by what mcap.dev and protobuf.dev say of the formats: the messages by
topic, decoded by the description that each file carries. Checks every length, offset, index and checksum on the way.

  python3 tests/read_mcap.py FILE     prints how many messages each topic has
"""
import pathlib
import struct
import sys
import zlib

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, INDEX, CHUNK_INDEX, STATISTICS, OFFSET, DATA_END = (
    1, 2, 3, 4, 5, 6, 7, 8, 11, 14, 15)


class Cursor:
    def __init__(self, data, at=0):
        self.data, self.at = data, at

    def take(self, count):
        assert self.at + count <= len(self.data), "cut off"
        self.at += count
        return self.data[self.at - count:self.at]

    def number(self, kind):
        return struct.unpack("<" + kind, self.take(struct.calcsize("<" + kind)))[0]

    def text(self):
        return self.take(self.number("I")).decode()

    def pairs(self, kinds):
        inner = Cursor(self.take(self.number("I")))
        while inner.at < len(inner.data):
            yield tuple(inner.number(kind) for kind in kinds)

    def records(self):
        while self.at < len(self.data):
            start = self.at
            kind = self.number("B")
            yield start, kind, self.take(self.number("Q"))


def fields(data):
    """(number, wire type, value) of a message."""
    cursor = Cursor(data)

    def varint():
        value = shift = 0
        while True:
            byte = cursor.number("B")
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    while cursor.at < len(data):
        key = varint()
        wire = key & 7
        value = (varint() if wire == 0 else cursor.take(8) if wire == 1 else cursor.take(varint()) if wire == 2
                 else cursor.take(4))
        yield key >> 3, wire, value


def first(data, number, default=b""):
    return next((value for n, _, value in fields(data) if n == number), default)


def described(descriptors):
    """Fields of all messages: {'.package.Name': {number: (name, type, type name, repeated)}}."""
    messages = {}
    for _, _, file in fields(descriptors):
        package = first(file, 2).decode()
        for number, _, message in fields(file):
            if number == 4:
                messages[f".{package}.{first(message, 1).decode()}"] = {
                    first(field, 3): (first(field, 1).decode(), first(field, 5), first(field, 6).decode(),
                                      first(field, 4) == 3)
                    for n, _, field in fields(message) if n == 2}
    return messages


def decoded(data, name, messages):
    out = {field: [] for field, _, _, repeated in messages[name].values() if repeated}
    for number, wire, value in fields(data):
        field, kind, type_name, repeated = messages[name][number]
        if kind == 11:
            value = decoded(value, type_name, messages)
        elif kind == 9:
            value = value.decode()
        elif kind == 1 and repeated:
            assert wire == 2  # packed
            out[field] += struct.unpack(f"<{len(value) // 8}d", value)
            continue
        elif kind == 1:
            value = struct.unpack("<d", value)[0]
        elif kind == 7:
            value = struct.unpack("<I", value)[0]
        else:
            assert (kind, wire) in {(3, 0), (5, 0), (8, 0), (14, 0), (12, 2)}, (kind, wire)
        if repeated:
            out[field].append(value)
        else:
            out[field] = value
    return out


def read(path):
    """{topic: [(time in ns, message), ...]} and {topic: schema}, in the order of the file."""
    data = pathlib.Path(path).read_bytes()
    assert data.startswith(MAGIC) and data.endswith(MAGIC), "magic"
    body = data[:-len(MAGIC)]
    schemas, channels, chunks, found = {}, {}, [], []
    summary, offsets, groups, ended = {}, [], {}, False
    for start, kind, content in Cursor(body, len(MAGIC)).records():
        cursor = Cursor(content)
        if kind == CHUNK:
            begin, end, size, crc, compression = [cursor.number(k) for k in "QQQI"] + [cursor.text()]
            records = cursor.take(cursor.number("Q"))
            assert compression == "" and size == len(records) and zlib.crc32(records) == crc, "chunk"
            here = {}
            for at, inner, record in Cursor(records).records():
                c = Cursor(record)
                if inner == SCHEMA:
                    number, name, encoding = c.number("H"), c.text(), c.text()
                    assert number > 0 and encoding == "protobuf"
                    schemas[number] = (name, described(c.take(c.number("I"))))
                elif inner == CHANNEL:
                    number, schema, topic, encoding = c.number("H"), c.number("H"), c.text(), c.text()
                    assert schema in schemas and encoding == "protobuf" and c.number("I") == 0
                    channels[number] = (topic, schema)
                else:
                    assert inner == MESSAGE
                    number, sequence, time, published = (c.number(k) for k in "HIQQ")
                    assert published == time and begin <= time <= end
                    assert sequence == sum(n == number for n, _, _ in found)
                    found.append((number, time, record[c.at:]))
                    here.setdefault(number, []).append((time, at))
            chunks.append([start, 9 + len(content), begin, end, len(records), here, {}])
        elif kind == INDEX:
            number = cursor.number("H")
            assert list(cursor.pairs("QQ")) == chunks[-1][5][number], "index"
            chunks[-1][6][number] = start
        elif kind == DATA_END:
            assert cursor.number("I") == 0
            ended = True
        elif kind == FOOTER:
            summary_at, offsets_at, crc = (cursor.number(k) for k in "QQI")
            assert zlib.crc32(body[summary_at:-4]) == crc and start + 9 + len(content) == len(body), "summary"
            assert min(summary) == summary_at and min(groups) == offsets_at, "footer"
        elif ended and kind == OFFSET:
            groups[start] = tuple(cursor.number(k) for k in "BQQ")
        elif ended:
            summary.setdefault(start, (kind, content))
        else:
            assert kind == HEADER
    for kind, at, length in groups.values():
        records = list(Cursor(body[:at + length], at).records())
        assert records and {k for _, k, _ in records} == {kind}, "summary offset"
        assert all(start in summary for start, _, _ in records)
    assert sum(length for _, _, length in groups.values()) == sum(9 + len(c) for _, c in summary.values())
    indexes = [Cursor(content) for kind, content in summary.values() if kind == CHUNK_INDEX]
    assert len(indexes) == len(chunks)
    for c, (at, length, begin, end, size, here, index_at) in zip(indexes, chunks):
        assert [c.number(k) for k in "QQQQ"] == [begin, end, at, length] and dict(c.pairs("HQ")) == index_at
        assert set(here) == set(index_at)
        inner = sum(9 + 2 + 4 + 16 * len(entries) for entries in here.values())
        assert [c.number("Q"), c.text(), c.number("Q"), c.number("Q")] == [inner, "", size, size]
    assert {kind for kind, _ in summary.values()} >= {SCHEMA, CHANNEL, CHUNK_INDEX, STATISTICS}
    c = Cursor(next(content for kind, content in summary.values() if kind == STATISTICS))
    times = [time for _, time, _ in found]
    assert [c.number(k) for k in "QHIIIIQQ"] == [len(found), len(schemas), len(channels), 0, 0, len(chunks), min(times),
                                                 max(times)], "statistics"
    assert dict(c.pairs("HQ")) == {n: sum(m == n for m, _, _ in found) for n in channels}
    topics = {topic: [] for topic, _ in channels.values()}
    for number, time, message in found:
        topic, schema = channels[number]
        name, messages = schemas[schema]
        topics[topic].append((time, decoded(message, "." + name, messages)))
    return topics, {topic: schemas[schema][0] for topic, schema in channels.values()}


if __name__ == "__main__":
    for topic_name, messages_of in read(sys.argv[1])[0].items():
        print(topic_name, len(messages_of))
