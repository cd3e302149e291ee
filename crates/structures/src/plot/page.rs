//! Self-contained HTML pages.

use std::fmt::Write as _;

use super::html::{anchor, escaped};
use super::panel;

/// Style sheet of a page for light and dark colours, narrow screens and paper. Large plots always have a light background.
const STYLE: &str =
    ":root{color-scheme:light dark;--text:#1a1a1a;--page:#fff;--rule:#ddd;--soft:#f3f5f8;--bad:#b00020;--bar:#0072b2}\
     @media(prefers-color-scheme:dark){:root{--text:#e8e8e8;--page:#16181c;--rule:#3c4048;--soft:#22262c;--bad:#ff8a80;\
     --bar:#56b4e9}}body{font:16px/1.5 system-ui,sans-serif;max-width:72rem;margin:2rem auto;padding:0 1rem;\
     color:var(--text);background:var(--page)}h1,h2,h3{line-height:1.25}h2{margin-top:2.5rem}p,dd,li{max-width:52rem}\
     .scroll{overflow-x:auto;margin:1rem 0}table{border-collapse:collapse;font-variant-numeric:tabular-nums}\
     caption{text-align:left;padding:.25rem 0}td,th{padding:.25rem .7rem;text-align:right;vertical-align:top;\
     border-bottom:1px solid var(--rule)}th:first-child,td.words,th.words{text-align:left}td.words{min-width:13rem}\
     td:not(.words){white-space:nowrap}\
     tbody th{font-weight:400;min-width:9rem}.plots{display:flex;flex-wrap:wrap;gap:1rem}\
     .plots svg{max-width:100%;height:auto;background:#fff;border-radius:6px}figure{margin:0;padding:.25rem;\
     background:#fff;color:#1a1a1a;border:1px solid var(--rule);border-radius:6px;flex:0 1 34.25rem}\
     .key{white-space:nowrap;margin-right:.6rem}figcaption{font-size:.85rem;padding:0 .5rem .4rem}\
     .lead{font-size:1.3rem;line-height:1.45}.facts{color:var(--text);\
     opacity:.85;font-size:.9rem}.card{background:var(--soft);border-radius:6px;padding:.75rem 1rem;margin:1rem 0}\
     .card h3{margin:0 0 .4rem}.bar{display:block;width:8rem;height:.6rem;background:var(--soft);fill:var(--bar)}\
     dt{font-weight:600}dd{margin:0 0 .6rem}.bad{color:var(--bad);font-weight:600}\
     .dense th{white-space:nowrap}.dense tbody th{min-width:0}.dense td,.dense th{padding:.2rem .5rem}\
     th.group{font-weight:600;text-align:left;padding-top:.8rem}\
     .dense tbody tr.first>*{border-top:1px solid var(--rule)}.dense tbody td,.dense tbody th{border-bottom:0}\
     .dense{border-bottom:1px solid var(--rule)}caption span{display:inline-block;position:sticky;left:0;\
     max-width:min(52rem,calc(100vw - 2.5rem))}svg.strip{display:block;width:8.75rem;height:1.1rem;margin-top:.2rem}\
     nav ul{padding-left:1.1rem}nav a{white-space:nowrap}a{color:var(--bar)}.quiet{opacity:.75;font-size:.85em}\
     details>summary{cursor:pointer}@media(max-width:40rem){.dense{font-size:.88rem}}@media print{h2,h3{break-after:avoid}body{margin:0;\
     max-width:none;font-size:11pt}figure,tr,.card{break-inside:avoid}.scroll{overflow:visible}td.words,tbody th{min-width:0}td,td:not(.words){white-space:normal;padding:.2rem .4rem}}";

/// A self-contained HTML page of sections with title and content. The content must already be HTML.
pub fn page(title: &str, sections: &[(String, String)]) -> String {
    let mut html = String::new();
    let title = escaped(title);
    write!(
        html,
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" \
         content=\"width=device-width,initial-scale=1\"><title>{title}</title><style>{STYLE}{}</style></head><body>\
         <h1>{title}</h1>",
        panel::STYLE
    )
    .expect("writing to memory cannot fail");
    for (heading, content) in sections {
        write!(html, "<section id=\"{}\"><h2>{}</h2>{content}</section>", anchor(heading), escaped(heading))
            .expect("writing to memory cannot fail");
    }
    html.push_str("</body></html>\n");
    html
}
