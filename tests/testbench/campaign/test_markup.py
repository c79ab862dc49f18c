"""HTML that cannot be broken by what is put into it."""

from html.parser import HTMLParser

from hypothesis import given
from hypothesis import strategies as st

from testbench.campaign.report.markup import Html, render, table, tag


class Texts(HTMLParser):
    """Collects elements and text."""

    def __init__(self) -> None:
        super().__init__()
        self.text = ""
        self.attributes: dict[str, str | None] = {}
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes.update(attrs)

    def handle_data(self, data: str) -> None:
        self.text += data


def read(html: str) -> Texts:
    parser = Texts()
    parser.feed(html)
    parser.close()
    return parser


@given(st.text(st.characters(codec="utf-8", exclude_characters="\r\0")))
def test_any_text_comes_back_as_text_and_as_attribute(given_text: str) -> None:
    """Names come from users' files: whatever they hold, it is text and nothing else."""
    found = read(tag("p", given_text, title=given_text))
    assert found.tags == ["p"]
    assert (found.text, found.attributes["title"]) == (given_text, given_text)


def test_what_was_built_here_is_not_escaped_twice() -> None:
    """An element inside an element."""
    assert tag("p", tag("b", "1 < 2"), " & 3") == "<p><b>1 &lt; 2</b> &amp; 3</p>"


def test_a_text_made_of_html_is_a_text_again() -> None:
    """Joining with + gives an ordinary text, which is escaped: forgetting something is harmless."""
    assert render(Html("<b>") + "x") == "&lt;b&gt;x"


def test_attribute_names_follow_python_names() -> None:
    """class_ for class, aria_label for aria-label."""
    assert tag("i", class_="bar", aria_label="x") == '<i class="bar" aria-label="x"></i>'
    assert tag("meta", name="viewport", content="x") == '<meta name="viewport" content="x">'


def test_table_has_caption_and_heads_for_columns_and_rows() -> None:
    """Accessible: a reader hears what a cell belongs to; the table scrolls by itself and can be reached by key."""
    made = table("Outcomes", ("point", "runs"), [("a", "1"), ("b", "2")])
    assert made.startswith('<div class="scroll" tabindex="0" role="region" aria-label="Outcomes"><table>')
    assert "<caption><span>Outcomes</span></caption>" in made
    assert made.count('scope="col"') == 2
    assert made.count('scope="row"') == 2
    assert '<td class="number">2</td>' in made
