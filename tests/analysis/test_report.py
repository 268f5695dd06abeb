"""report.html: what stands where, in a browser; what its sentences say."""

import json
import os
import re
import shutil
import subprocess
import tempfile
from dataclasses import replace
from html import escape, unescape
from unittest import mock

import pandas as pd
import pytest
from sweeps import NAN, SCALE, run, small_sweep, write_pairs, write_run

import analysis.verdicts
import analyze
from analysis.folders import SUCCESS


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Return the folder of the analysis of a small sweep."""
    path = tmp_path_factory.mktemp("sweep")
    small_sweep(path / "runs")
    run(path, drawn=True)
    return path / "results"


def in_browser(page, script, width, tmp_path):
    """Open `page` in a frame of this width and return what `script` returns there."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if not browser and os.environ.get("CI"):
        pytest.fail("chromium is missing, and CI must have it")
    if not browser:
        pytest.skip("chromium is not installed")
    # In a frame, because a headless window is never narrower than 500 pixels.
    frame = f'style="width: {width}px; height: 800px; border: 0"'
    wrapper = f"""<!DOCTYPE html><meta charset="utf-8"><pre id="answer"></pre><script>
        const answer = frame => {{ document.getElementById("answer").textContent =
          JSON.stringify(frame.contentWindow.eval({json.dumps(f"(() => {{ {script} }})()")})); }}
        </script>
        <base href="{page.parent.as_uri()}/">
        <iframe {frame} onload="answer(this)" srcdoc="{escape(page.read_text())}"></iframe>"""
    copy = tmp_path / "wrapper.html"
    copy.write_text(wrapper)
    flags = """--headless --no-sandbox --disable-gpu --disable-quic --no-first-run
        --disable-background-networking --disable-component-update --disable-sync --dump-dom
        --virtual-time-budget=10000 --window-size=1400,900"""
    with tempfile.TemporaryDirectory() as profile:
        command = [browser, *flags.split(), f"--user-data-dir={profile}", copy.as_uri()]
        dom = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
    return json.loads(unescape(re.search(r'<pre id="answer">(.*?)</pre>', dom, re.DOTALL)[1]))


FIRST_SCREEN = """
    document.querySelectorAll("details").forEach(details => details.open = true);
    const images = [...document.images], inside = images.filter(i => i.src.startsWith("data:"));
    const sentence = document.querySelector("#verdict li"), nav = document.querySelector("nav");
    const top = node => node.getBoundingClientRect().top;
    const all = name => [...document.querySelectorAll(name)];
    const shown = name => all(name).filter(node => node.offsetHeight > 0).length;
    return {width: document.documentElement.scrollWidth,
      scrolling: [...document.querySelectorAll("body *")].filter(node => !node.closest("table") &&
        !node.matches(".scroll") && node.scrollWidth > node.clientWidth + 1 &&
        getComputedStyle(node).overflowX !== "visible").length,
      broken: inside.filter(image => !image.naturalWidth).length,
      beside: images.filter(image => !inside.includes(image)).map(i => i.currentSrc),
      order: top(nav) < top(images[0]) && top(images[0]) < top(sentence),
      hints: shown(".hint"), tables: shown("table"),
      links: [...document.links].map(link => link.getAttribute("href"))};"""


@pytest.mark.slow
@pytest.mark.parametrize(("width", "end"), [(420, "_column"), (1280, "")])
def test_first_screen(width, end, results, tmp_path):
    """Contents, a picture, sentences; only tables scroll, and say so; no link leads elsewhere."""
    page = in_browser(results / "report.html", FIRST_SCREEN, width, tmp_path)
    assert page["width"] <= width and page["order"]
    assert page["scrolling"] == page["broken"] == 0
    beside = {address.rpartition("/")[2] for address in page["beside"]}
    noises = "RandomEarlyTermination_50", "RandomUniformScaleReward_0.5_1.5"
    assert beside == {f"curves_SAC_{noise}{end}.svg" for noise in noises}
    assert page["hints"] == (page["tables"] if width == 420 else 0)
    assert page["links"] and all(link.startswith("#") for link in page["links"])


def test_the_report_explains_its_words(results):
    page = (results / "report.html").read_text()
    for name in ("luck 95 % (p)", "detectable", "steps to baseline", "no clear difference"):
        [text] = re.findall(f"<dt>{re.escape(name)}</dt><dd>(.*)</dd>", page)
        if name != "detectable":  # a column of csv files and a bar in figures
            assert f'title="{text}">' in page
    assert "<dt>score" not in page


def test_a_section_that_is_empty_or_says_nothing_new_is_left_out(tmp_path):
    def sections():
        run(tmp_path)
        return re.findall('<section id="(.*?)">', (tmp_path / "results/report.html").read_text())

    write_pairs(tmp_path / "runs", [10, 11, 12], [20, 21, 22], rate=0.5)
    once = sections()
    assert once == ["verdict", "noises", "early_performance", "summary", "how"]
    write_pairs(tmp_path / "runs", [], [21, 22, 23], rate=0.2)
    assert set(sections()) - set(once) == {"best", "statistics"}
    for seed in range(4, 10):  # rates have no verdict now, and still intervals
        write_run(tmp_path / "runs", [10 + seed], seed=seed)
    assert "statistics" in sections()


def test_options_reach_what_they_are_of(tmp_path, capsys):
    """And what is not complete, or made by several versions, is said."""
    write_pairs(tmp_path / "runs", range(100, 106), range(100, 105))
    write_run(tmp_path / "runs", [1.0], seed=6, noise=SCALE, rate=0.1, finished=False)
    write_run(tmp_path / "runs", [106.0], seed=7, config={"versions": {"torch": "2.12.0"}})
    verdict = run(tmp_path, smallest_gain=100.0)["noises"]["verdict"]
    assert verdict.tolist() == ["no such gain"]
    said = capsys.readouterr().out
    assert "this sweep is not complete (1 unfinished)" in said
    assert "some rows average runs with different" in said
    args = analyze.Args(tmp_path / "runs", metric="success_rate", band="std")
    with mock.patch.object(analyze, "figures", return_value=[]) as drawn:
        analyze.main(replace(args, metric="return"))
    assert drawn.call_args.args[2] == "std"
    reads = mock.patch.object(analyze, "read_choice", side_effect=ValueError)
    with reads as read, pytest.raises(SystemExit):
        analyze.main(args)
    assert read.call_args.args == (tmp_path / "runs", SUCCESS)


def test_the_counts_at_the_top_are_those_of_the_list(tmp_path):
    for env in ("Hopper-v5", "Pusher-v5"):
        write_pairs(tmp_path / "runs", range(100, 105), range(130, 135), env=env)
        write_pairs(tmp_path / "runs", [], range(140, 145), rate=0.2, env=env)
    run(tmp_path)
    page = (tmp_path / "results/report.html").read_text()
    top, listed = page.split("</h1>")[1].split("<ul>", 1)
    assert "3 comparisons (1 noise in 2 environments, 1 in several environments together)" in top
    assert "3 better" in top and listed.split("</ul>")[0].count("<li>") == 3


@pytest.mark.parametrize(
    ("improvements", "p_luck", "expected"),
    [
        ([-5, 0], [0.9, 1], "Nothing that was tried"),
        ([5, 9], [0.3, 0.01], "On Hopper-v5 (p = 0.02) the best noise looks better"),  # Holm's
        ([5, 9], [0.3, 0.04], "On Ant-v5 and Hopper-v5 the best noise looks no better"),
        ([100, -5], [NAN, 0.7], "On Hopper-v5 the best noise looks no better"),  # too few seeds
        ([NAN, NAN], [NAN, NAN], ""),
    ],
)
def test_luck_is_said_in_one_sentence(improvements, p_luck, expected):
    best = {"environment": ["Ant-v5", "Hopper-v5"]}
    best |= {"difference": improvements, "p_luck": p_luck}
    said = analysis.verdicts.luck_sentence(pd.DataFrame(best))
    assert expected in said and bool(said) == bool(expected)
