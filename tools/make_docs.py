"""Builds a site of the pages and of the API's documentation, with pdoc: tools/make_docs.py FOLDER.

The project's page is index.html, each other page has a file of its own, and each module of `bson` and `macid` has one,
from its docstrings. Anything that pdoc warns of, and any link of a page that leads nowhere, is an error. Modules that
need another's package which is not installed are left out and named.
"""

import argparse
import contextlib
import html.parser
import importlib
import os
import pathlib
import pkgutil
import re
import shutil
import sys
import tempfile
import types
import urllib.parse
import warnings

import macid
from macid import command
from macid.command import Parser, check_words
from macid.files import UsageError, output_folder, write_bytes
from macid.running import run_command

ROOT = pathlib.Path(__file__).parents[1]
PACKAGES = ("bson", "macid")
PAGES = {  # file: the site's page, of the package of that name where there is one
    "README.md": "index",
    "bson/README.md": "bson",
    "macid/README.md": "macid",
    "assets/README.md": "files",
    "assets/results/README.md": "results",
    "assets/agents/README.md": "robot_policies",
    "assets/policies/README.md": "pedestrian_policies",
    "tests/README.md": "tests",
    "tools/CHANGELOG.md": "changelog",
}
STYLE = """
main img { max-width: 100%; }
main.pdoc { max-width: 75rem; padding-right: 2rem; }
.module-info:has(.docstring h1) > .modulename { display: none; }
"""
_LINK = re.compile(r"(\]\()([^)\s#:]+)(#[^)\s]*)?(\))")  # of Markdown, to a file: the path and the place in it


def page(file, out):
    """A page's text, whose links lead into the site in the folder `out`; other files that it names are copied there."""

    def link(match):
        path = pathlib.Path(os.path.normpath((ROOT / file).parent / match[2])).relative_to(ROOT).as_posix()
        if path in PAGES:
            return f"{match[1]}{PAGES[path]}.html{match[3] or ''}{match[4]}"
        if not (ROOT / path).is_file():
            raise UsageError(f"'{file}' links to '{match[2]}', which is no file.")
        (out / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / path, out / path)
        return f"{match[1]}{path}{match[3] or ''}{match[4]}"

    return _LINK.sub(link, re.sub(r"<!-- .*? -->\n?", "", (ROOT / file).read_text()))


def module_names():
    """Names of all modules of PACKAGES that can be imported, and what is left out: (names, [text, ...]).

    Raises UsageError for a module that can't be imported because of one of ours.
    """
    names, left_out = [], []
    for package in PACKAGES:
        names.append(package)
        found = pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}.", onerror=lambda _: None)
        for name in sorted(module.name for module in found):
            try:
                importlib.import_module(name)
                names.append(name)
            except ImportError as error:
                if (error.name or name).partition(".")[0] in PACKAGES:
                    raise UsageError(f"{name} can't be imported: {error}") from None
                left_out.append(f"{name}: {error}")
    return names, left_out


class _Places(html.parser.HTMLParser):
    """The ids and the local links of a page of HTML."""

    def __init__(self):
        super().__init__()
        self.ids, self.links = set(), set()

    def handle_starttag(self, tag, attributes):
        for name, value in attributes:
            if name == "id":
                self.ids.add(value)
            elif name in ("href", "src") and value and not re.match(r"[a-z]+:", value):
                self.links.add(value)


def broken_links(folder):
    """Links of the PAGES of the site in `folder` that lead nowhere: ["page.html: target", ...].

    Not of modules': there pdoc names what a class has of a private base, which it does not show.
    """
    places = {}
    for path in folder.rglob("*.html"):
        places[path] = _Places()
        places[path].feed(path.read_text())
    found = []
    for path in (folder / f"{name}.html" for name in PAGES.values()):
        place = places[path]
        for link in sorted(place.links):
            target, _, anchor = urllib.parse.unquote(link).partition("#")
            there = pathlib.Path(os.path.normpath(path.parent / target)) if target else path
            if not there.exists() or (anchor and there in places and anchor not in places[there].ids):
                found.append(f"{path.relative_to(folder)}: {link}")
    return found


def build(out):
    """Writes the site into the folder `out`; returns what is left out. Raises UsageError for warnings, broken links."""
    try:
        import pdoc.doc
        import pdoc.render
    except ImportError:
        raise UsageError("The site needs pdoc: pip install -e '.[docs]', or run tools/docs.sh.") from None
    os.environ.setdefault("MUJOCO_GL", "disabled")  # nothing is drawn here
    names, left_out = module_names()
    macid.load_policy = macid.load_policy  # comes once it is asked for, and pdoc doesn't ask
    with contextlib.ExitStack() as stack:
        told = stack.enter_context(warnings.catch_warnings(record=True))
        warnings.simplefilter("always")
        # Fields of dataclasses.make_dataclass: pdoc looks for them in the source, and its guess (this class) is right.
        warnings.filterwarnings("ignore", "Cannot determine where")
        templates = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
        (templates / "custom.css").write_text(STYLE)
        pdoc.render.configure(docformat="markdown", show_source=False, template_directory=templates)
        modules = {name: pdoc.doc.Module.from_name(name) for name in names}
        for parent, module in modules.items():  # all that can be imported, also where __all__ names none
            below = [other for name, other in modules.items() if name.rpartition(".")[0] == parent]
            module.__dict__["submodules"] = below
        for file, name in PAGES.items():
            if name not in modules:
                modules[name] = pdoc.doc.Module(types.ModuleType(name))
            modules[name].docstring = page(file, out)
        for name, module in modules.items():
            target = out / f"{name.replace('.', '/')}.html"
            target.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(target, pdoc.render.html_module(module, modules).encode())
        write_bytes(out / "search.js", pdoc.render.search_index(modules).encode())
    if told:
        raise UsageError(f"pdoc warns {len(told)} times, first: {' '.join(str(told[0].message).split())}")
    if broken := broken_links(out):
        raise UsageError(f"{len(broken)} links lead nowhere: {'; '.join(broken[:10])}")
    return left_out


def main():
    """Entry point."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=command.name, metavar="FOLDER", help="where the site is made")

    def read_and_run():
        check_words(sys.argv[1:])
        out = output_folder(parser.parse_args().out)
        for text in build(out):
            print(f"left out: {text}", file=sys.stderr)
        print(f"Written: {out / 'index.html'}")
        return 0

    return run_command("make_docs", read_and_run)


if __name__ == "__main__":
    sys.exit(main())
