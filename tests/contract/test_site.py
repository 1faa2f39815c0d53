"""The site's hook: what pages link to outside of ``docs/`` is on the site, and linked there."""

from pathlib import Path

from docs.repository_files import led, linked_files, links_of, page_of

ROOT = Path(__file__).parents[2]


def test_links_are_led_to_the_pages_of_the_site() -> None:
    text = (
        "[a](../blackbox/README.md#x) [b](../eval_agent.py) ![c](recording.png) [d](https://example.org/e.md)"
    )
    assert led(ROOT, "faq.md", text) == (
        "[a](repository/blackbox/README.md#x) [b](repository/eval_agent.py.md) ![c](recording.png) "
        "[d](https://example.org/e.md)"
    )
    assert led(ROOT, "tutorials/track.md", "[a](../../report.md)") == "[a](../repository/report.md)"


def test_pages_from_outside_lead_back() -> None:
    assert led(ROOT, "repository/report.md", "![a](docs/recording.png)") == "![a](../recording.png)"
    assert led(ROOT, "repository/blackbox/README.md", "[a](../docs/faq.md)") == "[a](../../faq.md)"
    assert led(ROOT, "repository/eval_agent.py.md", "[a](demo.py)") == "[a](demo.py.md)"


def test_code_and_folders_are_no_links() -> None:
    block = "```python\ntable[0](../eval_agent.py)\n```"
    assert led(ROOT, "faq.md", f"{block}\n[tests](../tests)") == f"{block}\ntests"
    assert links_of(f"{block}\n[wrapped\nwords](a.md)") == ["a.md"]


def test_what_pages_link_to_is_found_and_what_that_links_to() -> None:
    found = linked_files(ROOT, ["docs/exercise.md"])
    assert {"report.md", "eval_agent.py", "blackbox/README.md"} <= set(found)
    assert found["eval_agent.py"].startswith("# eval_agent.py\n\n````python\n")
    assert not any(path.startswith("docs/") for path in found)
    assert page_of("docs/envs/FlyTrack-v0.md") == "envs/FlyTrack-v0.md"
