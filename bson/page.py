"""What the HTML pages are made of. A page is one file: pictures and films are in it, and it needs no other."""

import base64
import html
import io

INK, ACCENT, BAD, GRID = "#1d2733", "#1f6f8b", "#c0392b", "#d9dfe5"

_STYLE = """
*{box-sizing:border-box}
body{font:15px/1.5 system-ui,-apple-system,'Segoe UI',Roboto,sans-serif;color:#1d2733;background:#f4f6f8;margin:0}
main{max-width:1180px;margin:0 auto;padding:28px 24px 60px}
h1{font-size:26px;line-height:1.25;margin:0 0 2px;overflow-wrap:anywhere} h2{font-size:18px;margin:34px 0 10px}
h3{font-size:14px;margin:0 0 6px;color:#5b6876} h4{font-size:13px;font-weight:600;margin:0 0 4px;color:#5b6876}
.sub{color:#5b6876;margin:0 0 20px} h2+.sub{margin-top:-6px;margin-bottom:12px} small{font-size:12px}
.note{background:#fff6e0;border:1px solid #ecd9a5;border-radius:10px;padding:8px 14px;margin:0 0 12px}
.top{display:grid;grid-template-columns:260px 1fr;gap:16px;margin-bottom:10px}
.head{background:#1f6f8b;color:#fff;border-radius:12px;padding:18px 22px}
.head b{font-size:58px;line-height:1.05;display:block} .head small{opacity:.85}
.cards{display:grid;grid-template-columns:repeat(auto-fill,minmax(185px,1fr));gap:12px}
.card{background:#fff;border:1px solid #e1e6eb;border-radius:10px;padding:10px 14px}
.card b{font-size:23px} .card span{display:block;color:#5b6876;font-size:13px} .card small{color:#5b6876}
figure{margin:0;background:#fff;border:1px solid #e1e6eb;border-radius:10px;padding:12px}
figure img,figure video{width:100%;display:block;border-radius:6px} figcaption{color:#5b6876;font-size:13px;margin-top:6px}
.films{display:grid;gap:14px} .ways{display:grid;grid-template-columns:repeat(auto-fill,minmax(300px,1fr));gap:14px}
.histograms{display:grid;grid-template-columns:repeat(auto-fill,minmax(250px,1fr));gap:12px} .wide{max-width:760px}
.plain,.scroll{background:#fff;border:1px solid #e1e6eb;border-radius:10px;overflow:auto} .scroll{max-height:420px}
.scroll td,.scroll th{font-size:13.5px;padding:4px 9px}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums} th,td{padding:5px 12px;text-align:right}
th{position:sticky;top:0;background:#eef2f5;font-weight:600;z-index:1;vertical-align:bottom}
tr:nth-child(even) td{background:#fafbfc} td small,th small{color:#5b6876}
td small{white-space:nowrap} .left{text-align:left}
.groups{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(355px,100%),1fr));gap:16px;align-items:start}
.groups td,.groups th{padding:3px 7px;font-size:13px} .groups th{white-space:nowrap} td.nowrap{white-space:nowrap}
details{margin-top:12px} summary{cursor:pointer;color:#1f6f8b} details .plain,details pre{margin-top:8px}
details td,details th{font-size:13px;padding:3px 12px}
pre{background:#fff;border:1px solid #e1e6eb;border-radius:10px;padding:12px;overflow:auto;font-size:13px;margin:0}
pre.wrap{white-space:pre-wrap;overflow-wrap:anywhere}
@media(max-width:640px){main{padding:18px 12px 40px} h1{font-size:22px} .top{grid-template-columns:1fr}
.cards{grid-template-columns:1fr 1fr;gap:8px} .card{padding:8px 10px} .card b{font-size:19px} .card small{display:block}
figure{padding:8px} .histograms{grid-template-columns:1fr 1fr;gap:8px} th,td{padding:4px 8px} .groups th,.groups td{padding:3px 6px}}
"""


def page(title, body, style=""):
    """The whole page as text; `body` is HTML, `title` plain text."""
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>
<meta name="viewport" content="width=device-width,initial-scale=1"><style>{_STYLE}{style}</style></head><body><main>
{body}
</main></body></html>
"""


def numbers(*values, digits=None, signed=False):
    """`values` as texts with the same number of decimals: `digits`, by default what shows three digits of the largest.

    signed: a plus before what is above 0.
    """
    largest = max(map(abs, values))
    if digits is None:
        digits = 0 if largest == 0 else sum(largest < bound for bound in (99.95, 9.995, 0.9995))
    rounded = [round(value, digits) + 0.0 for value in values]  # without -0
    return [f"{'+' if signed and value > 0 else ''}{value:.{digits}f}" for value in rounded]


def plural(count, noun):
    """Such as "1 episode", "27 episodes"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def new_figure(*args, **kwargs):
    """A Matplotlib figure made without pyplot, so that no display or global state is touched."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(*args, layout="constrained", **kwargs)
    FigureCanvasAgg(figure)
    return figure


def image(figure, caption, dots=130):
    """A Matplotlib figure as HTML, at `dots` pixels an inch."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dots, facecolor="white")
    content = base64.b64encode(buffer.getvalue()).decode()
    return (
        f'<figure><img alt="{html.escape(caption)}" src="data:image/png;base64,{content}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def video(path, caption):
    """The .webm film `path` as HTML."""
    content = base64.b64encode(path.read_bytes()).decode()
    return (
        f'<figure><video controls preload="metadata" src="data:video/webm;base64,{content}"></video>'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )
