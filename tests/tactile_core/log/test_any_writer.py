"""Logs of any writer: valid files are read completely, violations are reported."""

from __future__ import annotations

import io
import random
import struct
import tarfile
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer

from tactile_core.log.info import info
from tactile_core.log.mcap_file import MAGIC
from tactile_core.log.reader import LogReader, read_messages
from tactile_core.log.records import Block
from tactile_core.log.recovery import recover
from tests.support.paths import DATA

VECTORS = DATA / "mcap_conformance" / "vectors.tar.gz"
MESSAGES = {"OneMessage": 1, "OneSchemalessMessage": 1, "TenMessages": 10}
BASE_NS = 1_700_000_000_000_000_000


def test_every_conformance_vector_is_read_correctly(tmp_path: Path) -> None:
    with tarfile.open(VECTORS) as archive:
        archive.extractall(tmp_path, filter="data")
    wrong, count = [], 0
    for path in sorted(tmp_path.rglob("*.mcap")):
        kind, found = path.parent.name, info(path)
        told = found.messages, found.attachment_count, found.table_count, found.whole, found.orphans
        right = (
            MESSAGES.get(kind, 0), int(kind == "OneAttachment"), int(kind == "OneMetadata"), True, 0
        )  # fmt: skip
        count += 1
        if told != right:
            wrong.append((path.name, told, found.damages))
    assert wrong == []
    assert count == 416


# Small files of the same kind, written by hand


def text(value: str | bytes) -> bytes:
    data = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(data)) + data


def message(sequence: int, data: bytes = b"data", channel: int = 1, at: int | None = None) -> bytes:
    log_ns = BASE_NS + sequence if at is None else at
    return record(5, struct.pack("<HIQQ", channel, sequence, log_ns, log_ns) + data)


def record(opcode: int, body: bytes, appended: bytes = b"") -> bytes:
    body += appended
    return struct.pack("<BQ", opcode, len(body)) + body


class HandMade:
    """Records of a file with ``appended`` bytes after the fields of each, where allowed."""

    def __init__(self, appended: bytes = b"") -> None:
        self.more = appended
        self.schema = record(
            3, struct.pack("<H", 1) + text("T") + text("x") + text(b"def"), appended
        )
        channel = struct.pack("<HH", 1, 1) + text("/t") + text("json") + text(b"")
        self.channel = record(4, channel, appended)
        self.data = MAGIC + record(1, text("prof") + text("lib"), appended)

    def chunk(
        self, inner: bytes, compression: str = "", size: int | None = None, crc: int | None = None,
        packed: bytes | None = None,
    ) -> bytes:  # fmt: skip
        if packed is None:
            packed = zstandard.ZstdCompressor().compress(inner) if compression == "zstd" else inner
        head = struct.pack(
            "<QQQI", BASE_NS, BASE_NS + 10**10, len(inner) if size is None else size,
            zlib.crc32(inner) if crc is None else crc,
        )  # fmt: skip
        return record(
            6, head + text(compression) + struct.pack("<Q", len(packed)) + packed, self.more
        )

    def index(self, count: int) -> bytes:
        entries = b"".join(struct.pack("<QQ", BASE_NS + k, 0) for k in range(count))
        return record(7, struct.pack("<H", 1) + text(entries), self.more)

    def end(self, summary: bytes = b"", start: int | None = None) -> bytes:
        """The whole file; ``start``: start of the summary as stated in the footer."""
        data = self.data + record(15, bytes(4))
        if start is None:
            start = len(data) if summary else 0
        return data + summary + record(2, struct.pack("<QQI", start, 0, 0)) + MAGIC


def write(tmp_path: Path, data: bytes) -> Path:
    path = tmp_path / "x.mcap"
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("compression", ["", "zstd"])
def test_appended_fields_and_newer_records_are_skipped(tmp_path: Path, compression: str) -> None:
    made = HandMade(b"\x01\x02\x03later")
    other = record(0x42, b"reserved") + record(0x99, b"somebody's own")
    inner = other + made.schema + made.channel + b"".join(message(k) + other for k in range(7))
    made.data += other + made.chunk(inner, compression) + made.index(7) + other
    made.data += record(12, text("m") + text(text("k") + text("v")), made.more)
    made.data += record(
        9, bytes(16) + text("a") + text("t") + struct.pack("<Q", 2) + b"xy" + bytes(4), made.more
    )
    made.data += made.chunk(b"") + message(7)
    statistics = struct.pack("<QHIIIIQQI", 8, 1, 1, 1, 1, 2, BASE_NS, BASE_NS, 0)
    summary = made.schema + other + made.channel + record(11, statistics, made.more)
    for whole in (made.end(), made.end(summary)):
        found = info(write(tmp_path, whole))
        assert found.whole, found.damages
        assert (found.messages, found.attachment_count, found.table_count) == (8, 1, 1)
        assert [(c.topic, c.msgtype, c.missing) for c in found.channels] == [("/t", "T", 0)]
        assert recover(tmp_path / "x.mcap", tmp_path / "r.mcap").messages == 8
        (tmp_path / "r.mcap").unlink()


def test_violations_of_the_format_are_reported(tmp_path: Path) -> None:
    made = HandMade()
    start = made.data + made.schema + made.channel

    def told(data: bytes) -> tuple[int, str]:
        made.data = start + data
        found = info(write(tmp_path, made.end()))
        assert not found.whole
        return found.messages, found.damages[0].reason

    assert told(message(0) + record(0, b"") + message(1)) == (
        2,
        "record type 0, which does not exist",
    )
    assert told(made.chunk(message(0)[:-2]))[1] == "a chunk whose records do not fit into it"
    assert told(made.chunk(message(0) + made.chunk(message(1)))) == (1, "a chunk within a chunk")
    assert told(made.chunk(message(0), size=10**6, crc=0))[1].startswith("a chunk that unpacks to")
    assert told(made.chunk(message(0) + record(5, b"short"))) == (
        1, "a message is shorter than its fields"
    )  # fmt: skip
    clash = record(4, struct.pack("<HH", 1, 1) + text("/other") + text("json") + text(b""))
    assert told(clash + message(0)) == (1, "channel 1 is defined twice, and differently")
    lost, reason = told(made.chunk(message(0) * 3, "brotli") + made.index(3))
    assert (lost, reason) == (0, "a chunk compressed with 'brotli', which is not read here")
    assert info(tmp_path / "x.mcap").messages_lost == 3


def test_contradictory_footer_is_reported_and_loses_nothing(tmp_path: Path) -> None:
    made = HandMade()
    made.data += made.schema + made.channel + made.chunk(b"".join(map(message, range(10))))
    data_end = len(made.data) + 13
    summary = made.schema + made.channel
    for start in (8, data_end - 13, data_end + len(made.schema), data_end + 1, 10**12, 0):
        found = info(write(tmp_path, made.end(summary, start)))
        assert found.messages == 10, start
        assert found.messages_lost == found.lost_unknown == 0
        assert "footer says" in found.damages[0].reason, start
    assert info(write(tmp_path, made.end(summary))).whole


def test_data_checksum_is_verified_when_present(tmp_path: Path) -> None:
    stream = io.BytesIO()
    writer = Writer(stream, use_chunking=False, enable_data_crcs=True)
    writer.start()
    channel = writer.register_channel("/t", "json", 0)
    writer.add_message(channel, BASE_NS, b"some payload", BASE_NS)
    writer.add_metadata("m", {})
    writer.finish()
    data = stream.getvalue()
    assert info(write(tmp_path, data)).whole
    damaged = info(write(tmp_path, data.replace(b"payload", b"pAyload")))
    assert damaged.damages[0].reason == "the checksum over all the data is wrong"


def test_summary_with_more_messages_than_data_reports_a_loss(tmp_path: Path) -> None:
    made = HandMade()
    made.data += made.schema + made.channel + made.chunk(b"".join(map(message, range(10))))
    statistics = struct.pack("<QHIIIIQQI", 12, 1, 1, 0, 0, 1, BASE_NS, BASE_NS, 0)
    found = info(write(tmp_path, made.end(made.channel + record(11, statistics))))
    assert (found.messages, found.messages_lost) == (10, 2)
    assert "counts 12 messages, but 10 are in the file" in found.damages[0].reason


def test_flipped_chunk_record_type_is_not_mistaken_for_a_newer_version(tmp_path: Path) -> None:
    made = HandMade()
    made.data += made.schema + made.channel
    place = len(made.data)
    made.data += made.chunk(b"".join(map(message, range(10)))) + made.index(10)
    data = bytearray(made.end())
    for flipped in (0x46, 0x86, 0x16):
        data[place] = flipped
        found = info(write(tmp_path, bytes(data)))
        assert (found.messages, found.damage_count) == (10, 1)


@pytest.mark.parametrize("closed", [True, False])
def test_damaged_length_outside_chunks_costs_only_its_record(tmp_path: Path, closed: bool) -> None:
    made = HandMade()
    made.data += made.schema + made.channel
    places = []
    for number in range(10):
        places.append(len(made.data))
        made.data += message(number, b"a payload of some length")
    for place in places[:-1]:
        for byte, bit in ((1, 0x40), (1, 0x80), (3, 1), (6, 2), (8, 0x80)):
            data = bytearray(made.end() if closed else made.data)
            data[place + byte] ^= bit
            found = info(write(tmp_path, bytes(data)))
            lost = 10 - found.messages
            assert lost <= 1, (place, byte)
            assert found.messages_lost >= lost or found.lost_unknown, (place, byte)
            assert not found.whole


@pytest.mark.parametrize("closed", [True, False])
def test_damaged_length_of_a_chunk_costs_nothing(tmp_path: Path, closed: bool) -> None:
    made = HandMade()
    made.data += made.schema + made.channel
    place = len(made.data)
    for first in range(0, 40, 10):
        made.data += made.chunk(b"".join(message(first + k) for k in range(10))) + made.index(10)
    for bit in range(64):
        data = bytearray(made.end() if closed else made.data)
        data[place + 1 + bit // 8] ^= 1 << bit % 8
        found = info(write(tmp_path, bytes(data)))
        assert (found.messages, found.damage_count) == (40, 1), bit


def test_message_whose_record_type_is_wrong_is_told_as_lost(tmp_path: Path) -> None:
    made = HandMade()
    made.data += made.schema + made.channel
    place = len(made.data)
    made.data += b"".join(message(16 * number) for number in range(10))
    for bit in range(8):
        for at in (place, place + len(message(0)) * 4):
            data = bytearray(made.data)
            data[at] ^= 1 << bit
            found = info(write(tmp_path, bytes(data)))
            assert found.messages == 9, (bit, at)
            assert found.messages_lost + found.lost_unknown == 1, (bit, at)


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("checked", [True, False])
@pytest.mark.parametrize("closed", [True, False])
def test_no_flipped_bit_loses_messages_silently(
    tmp_path: Path, chunked: bool, checked: bool, closed: bool
) -> None:
    stream = io.BytesIO()
    writer = Writer(
        stream,
        chunk_size=200,
        compression=CompressionType.NONE,
        use_chunking=chunked,
        enable_crcs=checked,
    )
    writer.start()
    schema = writer.register_schema("T", "jsonschema", b"{}")
    channels = [writer.register_channel(topic, "json", schema) for topic in ("/a", "/b")]
    for number in range(12):
        at = BASE_NS + number * 1000
        writer.add_message(channels[number % 2], at, b"%08d" % number * 4, at, number)
    writer.finish()
    whole = stream.getvalue()
    data = whole if closed else whole[: whole.rindex(struct.pack("<BQ", 15, 4))]
    path = write(tmp_path, data)
    for at in random.Random(5).sample(range(8 * 8, len(data) * 8), 250):
        byte, bit = divmod(at, 8)
        with open(path, "r+b") as file:  # in place: to write it anew takes 50 times as long
            file.seek(byte)
            file.write(bytes([data[byte] ^ 1 << bit]))
        with LogReader(path) as reader:
            blocks = [e for e in reader.events() if isinstance(e, Block)]
            found = sum(len(list(reader.messages(block))) for block in blocks)
            told = found + reader.messages_lost
            assert told >= 12 or reader.lost_unknown, (byte, bit)
        with open(path, "r+b") as file:
            file.seek(byte)
            file.write(data[byte : byte + 1])


# Bounded memory


def peak_of(action: Callable[[], Any]) -> int:
    tracemalloc.start()
    try:
        action()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def zeros(size: int) -> bytes:
    return zstandard.ZstdCompressor().compress(bytes(size))


def test_decompression_bombs_take_little_memory(tmp_path: Path) -> None:
    made = HandMade()
    bomb = made.chunk(b"", "zstd", 200 << 20, 0, zeros(200 << 20))
    lying = made.chunk(b"", "zstd", 1000, 0, zeros(100 << 20))
    start = made.data
    for data, damages in ((bomb[:-20], 1), (bomb * 6, 6), (lying, 1)):
        path = write(tmp_path, start + data)
        found: list[Any] = []
        assert peak_of(lambda path=path, found=found: found.append(info(path))) < 16 << 20
        assert found[0].damage_count == damages
        assert found[0].lost_unknown == damages


def test_huge_compressed_message_is_counted_but_not_held(tmp_path: Path) -> None:
    made = HandMade()
    size = 150 << 20
    head = record(5, struct.pack("<HIQQ", 1, 0, BASE_NS, BASE_NS))[:1] + struct.pack(
        "<Q", 22 + size
    )
    inner = head + struct.pack("<HIQQ", 1, 0, BASE_NS, BASE_NS)
    packer = zstandard.ZstdCompressor().compressobj()
    packed = packer.compress(inner)
    for _ in range(150):
        packed += packer.compress(bytes(1 << 20))
    packed += packer.flush()
    made.data += made.schema + made.channel
    made.data += made.chunk(b"", "zstd", len(inner) + size, 0, packed)
    path = write(tmp_path, made.end())
    assert path.stat().st_size < 50_000
    found: list[Any] = []
    assert peak_of(lambda: found.append(info(path))) < 16 << 20
    assert found[0].messages == 1
    assert found[0].whole


def test_large_chunks_are_read_and_checked_in_pieces(tmp_path: Path) -> None:
    made = HandMade()
    inner = made.schema + made.channel + b"".join(message(k, bytes(100_000)) for k in range(240))
    for compression in ("zstd", ""):
        whole = HandMade()
        whole.data += whole.chunk(inner, compression)
        path = write(tmp_path, whole.end())
        assert peak_of(lambda path=path: info(path)) < 12 << 20
        assert info(path).messages == 240
        assert sum(len(m.data) for _, m in read_messages(path)) == 24_000_000
    wrong = HandMade()
    wrong.data += wrong.chunk(inner, "zstd", crc=1)
    assert (
        info(write(tmp_path, wrong.end())).damages[0].reason == "the checksum of a chunk is wrong"
    )


def test_attachments_and_messages_outside_chunks_may_be_large(tmp_path: Path) -> None:
    path, out = tmp_path / "x.mcap", tmp_path / "r.mcap"
    large = random.Random(1).randbytes(1 << 20) * 20
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start()
        channel = writer.register_channel("/t", "json", 0)
        writer.add_message(channel, BASE_NS, large, BASE_NS, 0)
        writer.add_attachment(BASE_NS, BASE_NS, "a", "t", large)
        writer.finish()
    found = info(path)
    assert found.whole
    assert (found.messages, found.files_within[0].size) == (1, len(large))
    recover(path, out)
    assert [m.data == large for _, m in read_messages(out)] == [True]
    with LogReader(out) as reader:
        (held,) = (e for e in reader.events() if not isinstance(e, Block))
        assert b"".join(reader.pieces_at(held.position, held.size)) == large  # type: ignore[union-attr]
    made = HandMade()
    body = bytes(16) + text("a") + text("t") + struct.pack("<Q", len(large)) + large
    made.data += made.schema + made.channel + message(0) + record(9, body + bytes(4))
    path.write_bytes(made.end())
    out.unlink()
    assert peak_of(lambda: recover(path, out)) < 8 << 20


# Data still readable after a bit flip


@pytest.mark.parametrize("compression", ["", "zstd"])
def test_data_readable_after_a_bit_flip_is_kept_on_request(
    tmp_path: Path, compression: str
) -> None:
    made = HandMade()
    rng = random.Random(3)
    messages = [message(k, rng.randbytes(40)) for k in range(100)]
    made.data += made.schema + made.channel
    damaged = bytearray(b"".join(messages))
    damaged[71 * 50 + 2] ^= 4  # a length, so that the next message is not at its stated place
    damaged[71 * 70 + 45] ^= 1  # in the data of another message
    made.data += made.chunk(bytes(damaged), compression, crc=zlib.crc32(b"".join(messages)))
    made.data += made.index(100) + record(12, text("m") + text(b""))
    path, out = write(tmp_path, made.end()), tmp_path / "out.mcap"
    strict = recover(path, out)
    assert (strict.messages, strict.messages_lost, strict.suspect) == (0, 100, 0)
    out.unlink()
    kept = recover(path, out, keep_suspect=True)
    assert (kept.messages, kept.messages_lost, kept.suspect) == (99, 1, 99)
    found = info(out)
    assert found.whole
    assert found.metadata["suspect"]["messages"] == "99"
    assert [m.sequence for _, m in read_messages(out)] == [*range(50), *range(51, 100)]


# Any valid file of the mcap package's writer


@st.composite
def files(draw: st.DrawFn) -> bytes:
    chunked = draw(st.booleans())
    kinds = (IndexType.NONE, IndexType.ALL, IndexType.CHUNK, IndexType.MESSAGE, IndexType.METADATA)
    stream = io.BytesIO()
    writer = Writer(
        stream,
        chunk_size=draw(st.sampled_from([1, 300, 5000])),
        compression=draw(st.sampled_from(list(CompressionType))),
        index_types=draw(st.sampled_from(kinds)),
        repeat_channels=draw(st.booleans()),
        repeat_schemas=draw(st.booleans()),
        use_chunking=chunked,
        use_statistics=draw(st.booleans()),
        use_summary_offsets=draw(st.booleans()),
        enable_crcs=draw(st.booleans()),
    )
    writer.start(profile=draw(st.sampled_from(["", "ros2"])), library="x")
    schema = writer.register_schema("T", "jsonschema", b"{}")
    channels = [
        writer.register_channel(name, "json", draw(st.sampled_from([0, schema])))
        for name in draw(st.lists(st.text(max_size=5), min_size=1, max_size=3))
    ]
    for kind in draw(st.lists(st.sampled_from("mmmmmat"), max_size=25)):
        if kind == "m":
            at = draw(st.integers(0, (1 << 64) - 1))
            data = bytes(draw(st.sampled_from([0, 1, 400, 9000])))
            number = draw(st.sampled_from([0, 7]))
            writer.add_message(draw(st.sampled_from(channels)), at, data, at // 2, number)
        elif kind == "a":
            writer.add_attachment(1, 2, draw(st.sampled_from(["a", "b"])), "t", b"abc")
        else:
            writer.add_metadata(draw(st.sampled_from(["a", "b"])), {"k": draw(st.text(max_size=4))})
    writer.finish()
    return stream.getvalue()


@settings(max_examples=80, deadline=None, derandomize=True)
@given(files())
def test_files_of_the_mcap_writer_read_as_with_the_mcap_reader(
    tmp_path_factory: pytest.TempPathFactory, data: bytes
) -> None:
    path = tmp_path_factory.mktemp("any") / "x.mcap"
    path.write_bytes(data)
    kinds = [type(each).__name__ for each in StreamReader(io.BytesIO(data)).records]
    right = [
        (m.channel_id, m.sequence, m.log_time, m.publish_time, m.data)
        for m in StreamReader(io.BytesIO(data)).records
        if isinstance(m, McapMessage)
    ]
    found = info(path)
    assert found.whole, found.damages
    assert found.messages == len(right)
    assert found.attachment_count == kinds.count("Attachment")
    assert found.table_count == kinds.count("Metadata")
    with LogReader(path) as reader:
        read = [m for e in reader.events() if isinstance(e, Block) for m in reader.messages(e)]
    assert [tuple(m) for m in read] == right
    times = sorted(m[2] for m in right)
    if times:  # seeking finds the same messages as reading everything
        first, last = times[len(times) // 3], times[len(times) * 2 // 3]
        with LogReader(path, window=(first, last)) as reader:
            inside = [
                tuple(m)
                for e in reader.events()
                if isinstance(e, Block)
                for m in reader.messages(e)
                if first <= m.log_ns <= last
            ]
        assert inside == [m for m in right if first <= m[2] <= last]
    if not (right or found.attachment_count or found.table_count):
        return  # nothing to recover: refused
    report = recover(path, path.with_name("r.mcap"))
    assert (report.messages, report.damage_count) == (len(right), 0)
    assert (report.attachments, report.metadata) == (found.attachment_count, found.table_count)
    assert sorted(m[1:] for _, m in read_messages(path.with_name("r.mcap"))) == sorted(
        m[1:] for m in right
    )


@settings(max_examples=100, deadline=None, derandomize=True)
@given(files(), st.data())
def test_corrupted_files_neither_raise_nor_hang(
    tmp_path_factory: pytest.TempPathFactory, data: bytes, drawn: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("damaged") / "x.mcap"
    damaged = bytearray(data[: drawn.draw(st.integers(20, len(data)))])
    for _ in range(drawn.draw(st.integers(0, 3))):
        damaged[drawn.draw(st.integers(8, max(8, len(damaged) - 1))) % len(damaged)] ^= 1 << (
            drawn.draw(st.integers(0, 7))
        )
    path.write_bytes(damaged)
    assert info(path).files == 1  # no traceback and no endless loop
    assert recover_or_nothing(path) >= 0


def recover_or_nothing(path: Path) -> int:
    from tactile_core.log.records import LogError

    try:
        return recover(path, path.with_name("r.mcap"), keep_suspect=True).messages
    except LogError:
        return 0
