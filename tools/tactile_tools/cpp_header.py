"""``tactile cpp-header``: C++ structs and a CDR decoder, made from the message definitions."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from tactile_core.bus.messages import OWN_PACKAGE, SHORT_NAMES, codec

BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4
"""Kinds of a field, in the numbering of rosbags."""

TYPES = {
    "bool": "bool", "byte": "std::uint8_t", "char": "std::uint8_t", "int8": "std::int8_t",
    "uint8": "std::uint8_t", "int16": "std::int16_t", "uint16": "std::uint16_t",
    "int32": "std::int32_t", "uint32": "std::uint32_t", "int64": "std::int64_t",
    "uint64": "std::uint64_t", "float32": "float", "float64": "double", "string": "std::string",
}  # fmt: skip

HEAD = """\
// Messages of tactile-reach and their CDR bytes. Made by `tactile cpp-header`; do not edit.
// C++17, no dependencies. Units and frames are those of the .msg files.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

namespace tactile {

// Bytes that are not a message of the type they were said to be.
struct DecodeError : std::runtime_error {
  using std::runtime_error::runtime_error;
};

// Reads CDR (XCDR1, either byte order) as ROS 2 writes it. Never reads past the end.
class Reader {
 public:
  Reader(const std::uint8_t* data, std::size_t size) : data_(data), size_(size), at_(4) {
    if (size < 4 || data[0] != 0 || data[1] > 1) throw DecodeError("not CDR");
    const std::uint16_t one = 1;
    std::uint8_t low;
    std::memcpy(&low, &one, 1);
    swap_ = (data[1] == 1) != (low == 1);
  }

  template <typename T>
  void read(T& value) {
    if constexpr (std::is_same_v<T, bool>) {
      std::uint8_t byte = 0;
      read(byte);
      value = byte != 0;
    } else if constexpr (std::is_arithmetic_v<T>) {
      at_ += (sizeof(T) - (at_ - 4) % sizeof(T)) % sizeof(T);
      std::uint8_t bytes[sizeof(T)];
      take(bytes, sizeof(T));
      if (swap_)
        for (std::size_t i = 0; i < sizeof(T) / 2; ++i)
          std::swap(bytes[i], bytes[sizeof(T) - 1 - i]);
      std::memcpy(&value, bytes, sizeof(T));
    } else {
      value.read(*this);
    }
  }

  void read(std::string& value) {
    const std::uint32_t length = count(1);
    value.assign(length, '\\0');
    if (length > 0) take(reinterpret_cast<std::uint8_t*>(&value[0]), length);
    if (length > 0) value.pop_back();  // the closing zero
  }

  template <typename T>
  void read(std::vector<T>& values) {
    values.assign(count(smallest<T>()), T{});
    for (std::size_t i = 0; i < values.size(); ++i) {
      T value{};
      read(value);
      values[i] = std::move(value);
    }
  }

  template <typename T, std::size_t N>
  void read(std::array<T, N>& values) {
    for (auto& value : values) read(value);
  }

 private:
  template <typename T>
  static constexpr std::size_t smallest() {
    if constexpr (std::is_arithmetic_v<T>) return sizeof(T);
    return 1;
  }

  // A count that could not be true takes no memory.
  std::uint32_t count(std::size_t element) {
    std::uint32_t found = 0;
    read(found);
    if (found > (size_ - at_) / element) throw DecodeError("a length beyond the end");
    return found;
  }

  void take(std::uint8_t* to, std::size_t length) {
    if (at_ > size_ || length > size_ - at_) throw DecodeError("too short");
    std::memcpy(to, data_ + at_, length);
    at_ += length;
  }

  const std::uint8_t* data_;
  std::size_t size_;
  std::size_t at_;
  bool swap_ = false;
};

template <typename T>
T decode(const std::uint8_t* data, std::size_t size) {
  Reader reader(data, size);
  T message;
  message.read(reader);
  return message;
}

"""


def run(options: argparse.Namespace) -> int:
    """Write the header to --out, or print it."""
    text = header()
    if options.out is None:
        print(text, end="")
        return 0
    try:
        options.out.write_text(text, encoding="utf-8")
    except OSError as error:
        print(
            f"tactile cpp-header: {options.out}: {error.strerror}; name another --out",
            file=sys.stderr,
        )
        return 3
    return 0


def header() -> str:
    """Return the text of the header."""
    done: list[str] = []
    own = [name for name in SHORT_NAMES.values() if name.startswith(OWN_PACKAGE)]
    for name in own:
        _visit(name, done)
    return HEAD + "\n".join(_struct(name) for name in done) + "\n}  // namespace tactile\n"


def _visit(msgtype: str, done: list[str]) -> None:
    """Append ``msgtype`` to ``done``, after all types that it contains."""
    if msgtype in done:
        return
    for _, (kind, arguments) in codec().fields(msgtype):
        if kind in (ARRAY, SEQUENCE):
            kind, arguments = arguments[0]
        if kind == NAME:
            _visit(arguments, done)
    done.append(msgtype)


def _struct(msgtype: str) -> str:
    fields = [(name, _type(*description)) for name, description in codec().fields(msgtype)]
    members = "\n".join(f"  {kind} {name}{{}};" for name, kind in fields)
    reads = "\n".join(f"    reader.read({name});" for name, _ in fields)
    return (
        f"// {msgtype}\nstruct {_short(msgtype)} {{\n{members}\n\n"
        f"  void read(Reader& reader) {{\n{reads}\n  }}\n}};\n"
    )


def _type(kind: int, arguments: Any) -> str:
    if kind == NAME:
        return _short(arguments)
    if kind == BASE:
        return TYPES[arguments[0]]
    inner = _type(*arguments[0])
    if kind == ARRAY:
        return f"std::array<{inner}, {arguments[1]}>"
    # std::vector<bool> packs bits and cannot hand out references to its elements.
    return f"std::vector<{'std::uint8_t' if inner == 'bool' else inner}>"


def _short(msgtype: str) -> str:
    return msgtype.rpartition("/")[2]
