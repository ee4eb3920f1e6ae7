"""The order of the rooms: `macid` knows no robot, and every module imports only what stands below it."""

import ast
import pathlib

import pytest

ROOT = pathlib.Path(__file__).parents[1]
# A room is a folder or a file of a package. Each imports rooms of earlier lines, and of its own line in no circle.
MACID = (
    "geometry start threads pages",
    "state files arrays assets",
    "documents occupancy cover running",
    "registry reward contacts",
    "routing layout observation encounters metrics",
    "networks readings",
    "encounter_policy",
    "policy",
    "maps scene executors cluster traits",
    "pedestrians engines drawing",
    "crowd forks",
    "learning export",
    "evaluate",
    "watch",
    "human",
    "live",
    "parallel_env",
    "bench benchmark command",
    "commands",
    "cli",
)
BSON = (
    "robot",
    "sensors task features guided recurrent",
    "simulation planners",
    "episodes",
    "agents",
    "interfaces dm",
    "evaluation",
    "reporting",
    "learning",
    "bench bench_warp benchmark doctor registry",
    "commands",
    "cli",
)
# What is reached for only when it is called: the entry points of the commands, and the cluster of an executor.
WHEN_CALLED = {("macid.start", "macid.cli"), ("macid.start", "bson.cli"), ("macid.executors", "macid.cluster")}


def modules():
    """{module: its file} of both packages."""
    files = [file for package in ("macid", "bson") for file in (ROOT / package).rglob("*.py")]
    return {".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): file for file in files}


MODULES = modules()


def imports(module, everywhere):
    """The modules of ours that `module` imports: at its top level, or `everywhere` in it."""
    tree, found = ast.parse(MODULES[module].read_text()), set()
    for node in ast.walk(tree) if everywhere else tree.body:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
    return {name for name in found if name in MODULES and name != module and not module.startswith(f"{name}.")}


def room(module):
    return ".".join(module.split(".")[:2])


def test_every_room_has_its_place_in_the_order():
    for package, order in (("macid", MACID), ("bson", BSON)):
        placed = " ".join(order).split()
        inside = [path for path in (ROOT / package).iterdir() if path.suffix in (".py", "")]
        there = {path.stem for path in inside if path.stem[:2] != "__"}
        assert len(placed) == len(set(placed)) and set(placed) == there, there ^ set(placed)


@pytest.mark.parametrize("module", sorted(MODULES))
def test_a_module_imports_only_what_stands_below_it(module):
    package, _, rest = module.partition(".")
    order = {name: number for number, line in enumerate(BSON if package == "bson" else MACID) for name in line.split()}
    for other in imports(module, everywhere=True):
        if package == "macid" and (module, room(other)) not in WHEN_CALLED:
            assert not other.startswith("bson"), f"{module} imports {other}: macid knows no robot"
        if other.partition(".")[0] != package or room(other) == room(module) or "." not in other or not rest:
            continue
        if (module, other) in WHEN_CALLED:
            continue
        above = f"{module} imports {other}, which stands above it"
        assert order[other.split(".")[1]] <= order[rest.split(".")[0]], above


@pytest.mark.parametrize("everywhere", [False, True])
@pytest.mark.parametrize("of", [lambda module: module, room])
def test_imports_make_no_circle(of, everywhere):
    graph = {}
    for module in MODULES:
        for other in imports(module, everywhere):
            if of(module) != of(other) and (module, room(other)) not in WHEN_CALLED:
                graph.setdefault(of(module), set()).add(of(other))
    done, doing = set(), []

    def visit(name):
        assert name not in doing, " -> ".join([*doing[doing.index(name) :], name])
        if name in done:
            return
        doing.append(name)
        for other in sorted(graph.get(name, ())):
            visit(other)
        done.add(doing.pop())

    for name in sorted(graph):
        visit(name)
