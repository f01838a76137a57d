"""Makes reStructuredText of docstrings, which are plain text and stay readable as that.

They have `code` between backticks, Google's sections, formulas and programs that stand indented,
and references one after the other, whose further lines are indented. Bars and asterisks mean
themselves.
"""

import re

SECTION = re.compile(r"[A-Z]\w+:")


def translate(app, what, name, thing, options, lines):
    """Rewrites the lines of a docstring in place, before napoleon reads them."""
    result, section, shown, code = [], "", False, False
    for line in lines:
        inside = line.startswith(" ")
        if line and not inside:
            section, shown = line if SECTION.fullmatch(line) else "", False
        if inside and not section:
            result += [line] if shown else ["::", "", line]
            shown = True
            continue
        line, code = plain(line, code)
        result.append(bullet(line) if section == "References:" and inside else line)
    lines[:] = result


def plain(line, code):
    """A line whose bars and asterisks mean themselves outside of code, and whether code goes on."""
    first, *others = line.split("`")
    result = first if code else escaped(first)
    for part in others:
        code = not code
        ends_before_word = not code and re.match(r"\w", part)
        result += "`" + ("\\ " if ends_before_word else "") + (part if code else escaped(part))
    return result, code


def escaped(text):
    """Without the markup that reStructuredText sees in |x|, a*b and c_."""
    return re.sub(r"([|*]|_(?!\w))", r"\\\1", text)


def bullet(line):
    """A reference as an item of a list."""
    deeper = line.startswith(" " * 5)
    return "      " + line.strip() if deeper else "    * " + line.strip()


def setup(app):
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", translate, priority=400)
    return {"parallel_read_safe": True}
