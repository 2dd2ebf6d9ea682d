"""The pieces of a report's pages."""

from cmedirl_jax.runs.report import markup


def test_a_page_escapes_what_it_shows():
    cells = [markup.name("<a>", "b&c"), markup.interval([1.0, None, 2.0]), markup.interval([None])]
    page = markup.document(
        "<t>", [markup.table(["x<"], [cells]), "", markup.definitions({"<": ">"})]
    )
    assert "<title>&lt;t&gt;</title>" in page
    assert "&lt;a&gt;<small>b&amp;c</small>" in page
    assert "1.00<small>[?, 2.00]</small>" in page
    assert '<td class="number">-</td>' in page
    assert "<dt>&lt;</dt><dd>&gt;</dd>" in page
