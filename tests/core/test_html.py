from html.parser import HTMLParser

import torch

from hybridkin import ConstantCurvatureChain, as_forward_model
from hybridkin._core.html import html_table

HOSTILE = '<script>alert("q")</script>'


class Balanced(HTMLParser):
    """Fails where tags are not closed in order."""

    def __init__(self):
        super().__init__()
        self.open, self.tags = [], []

    def handle_starttag(self, tag, attrs):
        self.open.append(tag)
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def tags_of(html):
    parser = Balanced()
    parser.feed(html)
    parser.close()
    assert parser.open == []
    return parser.tags


def test_every_text_is_escaped():
    html = html_table(HOSTILE, {HOSTILE: HOSTILE, "b": (HOSTILE, 1), "c": {HOSTILE: HOSTILE}})
    assert "script" not in tags_of(html)
    assert html.count("&lt;script&gt;") == 6


def test_values_none_tuples_and_tables():
    html = html_table("title", {"left out": None, "cells": ("a", "b"), "folded": {"c": 0}})
    assert "left out" not in html
    assert "<td>a</td><td>b</td>" in html
    assert html.count("<details open>") == 1
    assert html.count("<details>") == 1
    assert "<td>0</td>" in html


def test_models_show_what_they_know():
    html = ConstantCurvatureChain([0.1, 0.05], dtype=torch.float32)._repr_html_()
    assert "radii [m]</th><td>0.1, 0.05</td>" in html
    assert "2 segments, 6 actuators" in html
    tags_of(html)
    html = as_forward_model(lambda q: q)._repr_html_()
    assert html.count("<td>not known</td>") == 2
    tags_of(html)
