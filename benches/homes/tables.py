"""The tables of docs/tables.md, "Learning a home", from the output of `roomcast-lab habits --json`."""

NEXT_ROOM = ("mixture", "model", "counts", "stay")
NEXT_THING = ("mixture", "model", "counts", "without-model")
AHEAD = ("room-at-300s", "room-at-900s", "room-at-3600s")
NOTHING = "-"


def figure(report: dict, predictor: str, target: str, key: str = "nll_nats", day: int | str = "all") -> float | None:
    """One number of the report; None if there is no such case."""
    found = (row[key] for row in report["rows"] if (row["day"], row["predictor"], row["target"]) == (day, predictor, target))
    return next(found, None)


def losses(report: dict, predictors: tuple[str, ...], targets: tuple[str, ...], day: int | str = "all") -> str:
    values = [figure(report, predictor, target, day=day) for target in targets for predictor in predictors]
    return ", ".join(NOTHING if value is None else f"{value:.2f}" for value in values)


def percent(value: float | None) -> str:
    return NOTHING if value is None else f"{100 * value:.0f} %"


def sets(report: dict) -> str:
    """Number of places in a set, with habits and without."""
    return "; ".join(f"{row['size_mean']:.2f} of {row['size_mean_shipped']:.2f}" for row in report["sets"])


def saved(report: dict, policy: str) -> str:
    """Seconds of disturbance per hour saved by habits, with the interval, and the total without habits."""
    own = {row["predictor"]: row for row in report["cleaning"] if row["policy"] == policy}
    if not own or own["mixture"]["less"] is None:
        return NOTHING
    less, ends = own["mixture"]["less"]["disturbance_s_per_h"], own["mixture"]["less"]["disturbance_ci95"]
    interval = f" [{round(-ends[1])}, {round(-ends[0])}]" if ends else ""
    return f"{round(-less)}{interval} of {round(own['model']['disturbance_s_per_h'])}"


def markdown(header: list[str], rows: list[list[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def rooms(reports: dict[str, dict]) -> str:
    """Next rooms and later rooms; one home per row."""
    header = [
        "home",
        "next room: mixture, model, counts, stay",
        "given a change: right",
        "+5, +15, +60 min: mixture",
        "the same: fitted persistence",
        "the same: model",
        "sets for +1, +5, +15, +60 min: places, of shipped",
        "robot's disturbance, s per hour less: at equal coverage; by the default price",
    ]
    rows = []
    for home, report in reports.items():
        later = [losses(report, (predictor,), AHEAD) for predictor in ("mixture", "persistence", "model")]
        changed = percent(figure(report, "mixture", "room-if-changed", "top1"))
        robot = f"{saved(report, 'always-covers')}; {saved(report, 'coverage-aware')}"
        rows.append([home, losses(report, NEXT_ROOM, ("room",)), changed, *later, sets(report), robot])
    return markdown(header, rows)


def things(reports: dict[str, dict]) -> str:
    """The next thing other than the last one, over all days and on the first day; one home per row."""
    who = ", ".join(NEXT_THING)
    rows = []
    for home, report in reports.items():
        days = [row["day"] for row in report["rows"] if row["target"] == "object" and isinstance(row["day"], int)]
        first = losses(report, NEXT_THING, ("object",), min(days, default=1))
        rows.append([home, losses(report, NEXT_THING, ("object",)), first])
    return markdown(["home", f"next thing, all days: {who}", f"first day: {who}"], rows)
