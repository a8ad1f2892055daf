"""The look of a report: one style sheet, for screens light and dark and for paper. It names no file of others."""

from __future__ import annotations

from collections.abc import Iterable

from slrig.sessions.markup import Markup, tag

STYLE = """
:root{--page:#f5f6f8;--card:#fff;--ink:#17222e;--dim:#5b6875;--line:#dfe3e8;--accent:#1c6f8c;--hatch:#e9ecf0;
--good:#1d7a46;--usable:#a06200;--bad:#b3261e;--board:#1c6f8c}
@media (prefers-color-scheme:dark){:root{--page:#12171d;--card:#1b222a;--ink:#e6ebf0;--dim:#9aa7b4;--line:#313b46;
--accent:#6cc3dd;--hatch:#262f39;--good:#5fcf8f;--usable:#eeb04a;--bad:#ff8a80;--board:#6cc3dd}}
*{box-sizing:border-box}
html{-webkit-text-size-adjust:100%}
body{margin:0;background:var(--page);color:var(--ink);font:15px/1.5 system-ui,"Segoe UI","Liberation Sans",sans-serif}
main{max-width:1080px;margin:0 auto;padding:28px 20px 60px}
h1{font-size:25px;margin:0;letter-spacing:-.01em}
h2{font-size:18px;margin:38px 0 4px}
h3{font-size:15px;margin:0 0 8px}
p{margin:4px 0 10px;max-width:76ch}
.dim,figcaption,.lead{color:var(--dim)}
.lead{font-size:14px}
.facts{color:var(--dim);font-size:13.5px;margin:2px 0 0}
.card{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:16px 18px;margin:14px 0}
.verdict{border-left:8px solid var(--grade);padding:16px 22px}
.verdict .word{color:var(--grade);font-size:27px;font-weight:700;line-height:1.2}
.verdict p{font-size:16px;margin:6px 0 0}
.verdict ul{margin:8px 0 0;padding-left:20px}
.good{--grade:var(--good)}.usable{--grade:var(--usable)}.do_not_use{--grade:var(--bad)}
.verdict .more{font-size:13px;color:var(--dim);margin-top:4px}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(300px,1fr));gap:12px;margin:14px 0}
.tile{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:13px 16px}
.tile .name{color:var(--dim);font-size:13px}
.tile .value{font-size:25px;font-weight:650;font-variant-numeric:tabular-nums;white-space:nowrap}
.tile .value small{font-size:14px;font-weight:400;color:var(--dim)}
.tile .note{font-size:12.5px;color:var(--dim);line-height:1.4;margin-top:3px}
.row{display:grid;grid-template-columns:repeat(auto-fit,minmax(270px,1fr));gap:18px;align-items:start}
div.row{margin-top:16px}section>div.row:first-child{margin-top:0}
.row.narrow{grid-template-columns:repeat(auto-fill,minmax(190px,1fr));gap:12px}
figure{margin:0}
figcaption{font-size:12.5px;line-height:1.4;margin-top:6px}
.chart{display:block;width:100%;height:auto;border-radius:5px;overflow:visible}
.legend{display:block;width:330px;max-width:100%;height:auto;margin:10px 0 2px;overflow:visible}
img{display:block;width:100%;height:auto;border-radius:6px}
.table{overflow-x:auto}
table{border-collapse:collapse;width:100%;font-size:13.5px;font-variant-numeric:tabular-nums}
th{text-align:right;font-weight:600;color:var(--dim);padding:5px 9px;border-bottom:1px solid var(--line);
vertical-align:bottom}
td{text-align:right;padding:4px 9px;border-bottom:1px solid var(--line);white-space:nowrap}
th:first-child,td:first-child{text-align:left;padding-left:0}
td.words,th.words{text-align:left;white-space:normal;min-width:210px;line-height:1.4}
tr:last-child td{border-bottom:0}
tr.outlier td:first-child{color:var(--bad);font-weight:600}
td .sigma{color:var(--dim)}
.bar{display:inline-block;width:64px;height:8px;margin-left:8px;background:var(--hatch);border-radius:4px;
vertical-align:1px;overflow:hidden}
.bar i{display:block;height:100%;background:var(--accent)}
.remark{color:var(--usable)}.reason{color:var(--bad)}
svg text{font-family:inherit;fill:var(--dim)}
svg .tick{font-size:10px}svg .end{text-anchor:end}
svg .label{font-size:11px;fill:var(--ink);text-anchor:middle}
svg .cell-value{font-size:9.5px;text-anchor:middle;font-variant-numeric:tabular-nums}
svg .cell-value[fill="#ffffff"]{fill:#fff}svg .cell-value[fill="#10202f"]{fill:#10202f}
svg .cell{stroke:var(--card);stroke-width:1}
svg .unseen{fill:var(--hatch);stroke:var(--card);stroke-width:1}
svg .arrow{fill:none;stroke-width:1.3}
svg .grid{stroke:var(--line);fill:none;stroke-width:1}
svg .frame{fill:none;stroke:var(--dim);stroke-width:1}
svg .board{fill:var(--board);fill-opacity:.07;stroke:var(--board);stroke-opacity:.75;stroke-width:1}
svg .board.outlier{fill:var(--bad);stroke:var(--bad);stroke-dasharray:4 3}
svg .dots{stroke:var(--board);stroke-width:2;stroke-linecap:round;stroke-opacity:.55;fill:none}
svg .cone{fill:var(--accent);fill-opacity:.09;stroke:var(--accent);stroke-opacity:.45;stroke-width:1}
svg .cone.light{fill:var(--usable);stroke:var(--usable)}
svg .volume{fill:none;stroke:var(--ink);stroke-dasharray:5 4;stroke-width:1}
svg .camera{fill:var(--accent)}svg .projector{fill:var(--usable)}
svg .ruler{fill:none;stroke:var(--ink);stroke-width:1.2}
footer{color:var(--dim);font-size:12.5px;margin-top:34px;border-top:1px solid var(--line);padding-top:12px}
@media print{:root{--page:#fff;--card:#fff;--ink:#111;--dim:#555;--line:#ccc;--accent:#1c6f8c;--hatch:#eee;
--good:#1d7a46;--usable:#a06200;--bad:#b3261e;--board:#1c6f8c}
@page{margin:13mm}
body{font-size:10.5px}main{max-width:none;padding:0}.verdict,.tile,figure,tr{break-inside:avoid}
h2,h3,.lead,thead{break-after:avoid}h1{font-size:19px}h2{font-size:14px;margin-top:18px}h3{font-size:12px}
p{margin:2px 0 5px}
.verdict .word{font-size:20px}.verdict p,.lead,.facts{font-size:11px}
.verdict .more,figcaption,.tile .note{font-size:9.5px}
.tiles{grid-template-columns:repeat(3,1fr);gap:8px}.tile{padding:8px 10px}.tile .value{font-size:18px}
.tile .name{font-size:10px}
.row{grid-template-columns:1fr 1fr;gap:12px}.row.three{grid-template-columns:repeat(3,1fr)}
.row.narrow{grid-template-columns:repeat(4,1fr)}table{font-size:10px}th,td{padding:2px 7px}td.words{line-height:1.3}
*{-webkit-print-color-adjust:exact;print-color-adjust:exact}.card{padding:10px 12px}}
""".strip()


def report_page(title: str, sections: Iterable[str | None]) -> str:
    """A report as one page of HTML that needs no other file."""
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="color-scheme", content="light dark"),
        tag("title", title),
        tag("style", Markup(STYLE)),
    )
    page = tag("html", head, tag("body", tag("main", *sections)), lang="en")
    return f"<!DOCTYPE html>\n{page}\n"
