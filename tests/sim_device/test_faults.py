"""Fault plans from text."""

from __future__ import annotations

import math

import pytest

from sim_device.faults import ALL_TAXELS, FaultPlan, TaxelFault, TaxelFaultKind, Window
from tactile_core.config import ConfigError


def test_fault_plan_is_parsed_from_text() -> None:
    plan = FaultPlan.parse(
        "seed=7, flip=1e-5,loss=0.01,delay=0.5:0.1s,silence@5s+2s,silence@9s+1s,reset@8s,"
        "stuck=left:3@2s,failed=tip:0@1s+0.5s,saturated=right:31,busoff@3.5s+0.25s"
    )
    assert plan == FaultPlan(
        seed=7,
        flip=1e-5,
        loss=0.01,
        delay=0.5,
        delay_s=0.1,
        silence=(Window(5, 2), Window(9, 1)),
        reset=(8.0,),
        busoff=(Window(3.5, 0.25),),
        taxels=(
            TaxelFault(TaxelFaultKind.STUCK, "left", 3, Window(2)),
            TaxelFault(TaxelFaultKind.FAILED, "tip", 0, Window(1, 0.5)),
            TaxelFault(TaxelFaultKind.SATURATED, "right", 31, Window(0)),
        ),
    )


def test_nan_is_a_failed_read() -> None:
    assert FaultPlan.parse("nan=tip:1@2s") == FaultPlan.parse("failed=tip:1@2s")


def test_every_chip_fault_can_be_permanent_or_intermittent() -> None:
    text = ",".join(f"{kind}=skin:1@2s" for kind in TaxelFaultKind)
    assert [fault.kind for fault in FaultPlan.parse(text).taxels] == list(TaxelFaultKind)
    plan = FaultPlan.parse("zeros=skin:*:0.05@4s+2s,copy@1s+2s")
    assert plan.taxels == (
        TaxelFault(TaxelFaultKind.ZEROS, "skin", ALL_TAXELS, Window(4, 2), share=0.05),
    )
    assert plan.copy == (Window(1, 2),)


def test_empty_text_is_no_fault() -> None:
    assert FaultPlan.parse("") == FaultPlan()
    assert not FaultPlan.parse("").touches_wire
    assert FaultPlan.parse("loss=0.1").touches_wire


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("flip", "fault 'flip' is not understood; allowed: seed=N"),
        ("flop=0.1", "fault 'flop=0.1' is not understood; allowed"),
        ("flip=1.5", "fault 'flip=1.5': allowed: a probability from 0 to 1"),
        ("flip=-1", "allowed: a probability from 0 to 1"),
        ("loss=nan", "allowed: a probability from 0 to 1"),
        ("loss=0.1,loss=0.2", "loss is given twice"),
        ("seed=1,seed=1", "seed is given twice"),
        ("seed=-1", "allowed: a whole number"),
        ("seed=1.5", "allowed: a whole number"),
        ("delay=0.1:2", "allowed: PROBABILITY:SECONDSs"),
        ("silence@5s", "allowed: Ts[+]Ds"),
        ("silence=5s+1s", "not understood"),
        ("reset@5", "allowed: Ts, seconds after power-on"),
        ("reset@5s+1s", "allowed: Ts, seconds after power-on"),
        ("stuck=left", "allowed: ARRAY:TAXEL"),
        ("stuck=left:x", "allowed: ARRAY:TAXEL"),
        ("stuck=left:1@", "allowed: ARRAY:TAXEL"),
        ("stuck@2s", "not understood"),
        ("zeros=skin:2:0@2s", "allowed: a SHARE above 0 and up to 1"),
        ("zeros=skin:2:1.5", "allowed: a SHARE above 0 and up to 1"),
        ("zeros=skin:**", "allowed: ARRAY:TAXEL"),
        ("copy@2s", "allowed: Ts[+]Ds"),
    ],
)
def test_bad_text_names_the_entry_and_allowed_values(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        FaultPlan.parse(text)


def test_plan_refuses_figures_out_of_range() -> None:
    with pytest.raises(ValueError, match="flip is a probability"):
        FaultPlan(flip=math.nan)
    with pytest.raises(ValueError, match="delay_s"):
        FaultPlan(delay_s=math.inf)
