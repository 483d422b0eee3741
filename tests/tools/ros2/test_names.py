"""Keys and tokens as rmw_zenoh's design document prints them, and the package for a workspace."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tactile_core.bus.messages import codec
from tactile_core.bus.topics import TOPICS
from tactile_tools.ros2 import package
from tactile_tools.ros2.bridge import DERIVED
from tactile_tools.ros2.names import Endpoint, Node, Qos, dds_type, mangle, ros_name
from tests.support.paths import ROOT

STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"


def test_tokens_are_those_of_the_published_examples() -> None:
    listener = Node(2, "aac3178e146ba6f1fc6e6a4085e77f21", "listener")
    talker = Node(2, "8b20917502ee955ac4476e0266340d5c", "talker")
    hears = Endpoint(listener, 10, "MS", "/chatter", "std_msgs/msg/String", STRING_HASH)
    says = Endpoint(talker, 10, "MP", "/chatter", "std_msgs/msg/String", STRING_HASH, Qos(depth=7))
    assert listener.token == "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
    assert hears.token == (
        "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/%chatter/"
        f"std_msgs::msg::dds_::String_/{STRING_HASH}/::,10:,:,:,,"
    )
    assert says.token == (
        "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/"
        f"std_msgs::msg::dds_::String_/{STRING_HASH}/::,7:,:,:,,"
    )
    assert says.key == f"2/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"


def test_string_hash_is_the_published_one() -> None:
    assert codec().schema("std_msgs/msg/String").type_hash == STRING_HASH


def test_namespaces_stand_in_keys_and_tokens() -> None:
    node = Node(0, "1f", "bridge", "/robot1/hand")
    assert node.token == "@ros2_lv/0/1f/0/0/NN/%/%robot1%hand/bridge"
    assert node.resolve("tactile/left/features") == "/robot1/hand/tactile/left/features"
    assert node.resolve("/tf") == "/tf"
    endpoint = Endpoint(node, 3, "MP", node.resolve("a/b"), "std_msgs/msg/String", "H")
    assert endpoint.key == "0/robot1/hand/a/b/std_msgs::msg::dds_::String_/H"
    assert "/%robot1%hand%a%b/" in endpoint.token


@pytest.mark.parametrize(
    ("qos", "token"),
    [
        (Qos(), "::,10:,:,:,,"),
        (Qos(reliable=False), "2::,10:,:,:,,"),
        (Qos(transient_local=True, depth=1), ":1:,1:,:,:,,"),
    ],
)
def test_qos_tokens(qos: Qos, token: str) -> None:
    assert qos.token == token


def test_names_are_adapted_to_ros() -> None:
    assert ros_name("left-finger") == "left_finger"
    assert ros_name("0left") == "_0left"
    assert mangle("") == "%"
    with pytest.raises(ValueError, match="not a type"):
        dds_type("std_msgs/String")


def test_standard_types_have_one_hash_from_humble_to_jazzy() -> None:
    ours = {topic.msgtype for topic in TOPICS} | {"geometry_msgs/msg/PoseStamped"}
    ours |= {kind for rows in DERIVED.values() for _, kind, _ in rows}
    jazzy = get_typestore(Stores.ROS2_JAZZY)
    standard = sorted(name for name in ours if not name.startswith("tactile_msgs/"))
    assert len(standard) >= 7
    for name in standard:
        assert jazzy.hash_rihs01(name) == codec().schema(name).type_hash, name


def test_package_in_the_repository_is_up_to_date() -> None:
    folder = ROOT / "ros2" / package.PACKAGE
    found = {
        str(path.relative_to(folder)): path.read_text(encoding="utf-8")
        for path in folder.rglob("*")
        if path.is_file()
    }
    assert found == package.files(), "run `tactile ros2 package --out ros2/tactile_msgs`"


def test_package_defines_the_types_that_are_sent() -> None:
    """Parsed from its files into another store, every type has the hash that goes on the wire."""
    folder = ROOT / "ros2" / package.PACKAGE
    store = get_typestore(Stores.ROS2_JAZZY)
    types = {}
    for path in sorted(folder.glob("msg/*.msg")):
        types |= get_types_from_msg(path.read_text(), f"{package.PACKAGE}/msg/{path.stem}")
    store.register(types)
    names = sorted(types)
    assert len(names) == 12
    for name in names:
        assert store.hash_rihs01(name) == codec().schema(name).type_hash, name
    used = {n.split("/")[0] for name in names for n in _types_of(name)} - {package.PACKAGE}
    assert used == set(package.DEPENDENCIES)


def _types_of(name: str) -> set[str]:
    found = set()
    for _, (kind, detail) in codec().fields(name):
        if kind in (3, 4):
            kind, detail = detail[0]
        if kind == 2:
            found.add(detail)
    return found


def test_package_xml_names_what_ros_needs() -> None:
    root = ElementTree.parse(ROOT / "ros2" / package.PACKAGE / "package.xml").getroot()
    assert root.findtext("name") == package.PACKAGE
    assert root.findtext("member_of_group") == "rosidl_interface_packages"
    assert {e.text for e in root.findall("depend")} == set(package.DEPENDENCIES)


def test_package_is_written_and_old_definitions_are_deleted(tmp_path: Path) -> None:
    out = tmp_path / "tactile_msgs"
    (out / "msg").mkdir(parents=True)
    (out / "msg" / "Old.msg").write_text("int8 x\n")
    command = Path(sys.executable).with_name("tactile")
    done = subprocess.run(
        [command, "ros2", "package", "--out", out], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert not (out / "msg" / "Old.msg").exists()
    assert (out / "CMakeLists.txt").read_text() == package.files()["CMakeLists.txt"]
