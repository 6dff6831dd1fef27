"""Looks at the built site in a headless Chromium, on a wide and on a narrow screen, light and dark.

    python docs/browser.py site

Says which pages overflow the screen, cut off a line of code, lack a picture or write errors to the
console, and exits with status 1 if any does. Without Chromium it says so, and looks at nothing.
"""

import functools
import html
import http.server
import json
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

WIDTHS = (1920, 1280, 390)
# From here on a line of code must not be cut off; on a telephone it scrolls.
WHOLE = 1280
# Blink's numbers.
SCHEMES = {"dark": 0, "light": 1}
HARNESS = "seen-in-a-browser.html"
SECONDS_MAX = 240

# Every page in a frame as wide as the screen, one after the other. Only what scrolls by itself, as
# code, formulas and tables do, may be wider than the screen.
SCRIPT = """
<!doctype html><body><script>
const pages = PAGES, widths = WIDTHS, found = [];
function look(page, width) {
  return new Promise(done => {
    const frame = document.createElement("iframe");
    frame.style.cssText = `width: ${width}px; height: 900px; border: 0`;
    frame.onload = () => setTimeout(() => {
      const page_ = frame.contentDocument, root = page_.documentElement;
      for (const image of page_.images) image.loading = "eager";
      setTimeout(() => {
        for (const code of page_.querySelectorAll("pre > code")) {
          const [line] = code.innerText.trim().split("\\n");
          if (width >= WHOLE && code.scrollWidth > code.clientWidth)
            found.push(`${page} at ${width} pixels: cut off: ${line}`);
        }
        if (root.scrollWidth > root.clientWidth)
          found.push(`${page} at ${width} pixels: ${root.scrollWidth} pixels wide`);
        for (const image of page_.images)
          if (!image.complete || image.naturalWidth === 0)
            found.push(`${page}: no picture ${image.getAttribute("src")}`);
        frame.remove();
        done();
      }, 30);
    }, 30);
    frame.src = page;
    document.body.append(frame);
  });
}
(async () => {
  for (const page of pages) for (const width of widths) await look(page, width);
  const result = document.createElement("pre");
  result.id = "found";
  result.textContent = JSON.stringify(found);
  document.body.append(result);
})();
</script></body>
"""


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format, *args):
        del format, args


def chromium() -> str | None:
    names = ("chromium", "chromium-browser", "google-chrome", "chrome")
    return next(filter(None, map(shutil.which, names)), None)


def problems(site: Path, browser: str) -> list[str]:
    """What is wrong with the site in this folder, one line each."""
    pages = sorted(
        file.relative_to(site).as_posix()
        for file in site.rglob("*.html")
        if file.name != HARNESS and 'http-equiv="refresh"' not in file.read_text(encoding="utf-8")
    )
    values = {"PAGES": pages, "WIDTHS": WIDTHS, "WHOLE": WHOLE}
    text = SCRIPT
    for name, value in values.items():
        text = text.replace(name, json.dumps(value))
    (site / HARNESS).write_text(text, encoding="utf-8")
    handler = functools.partial(Quiet, directory=str(site))
    found = []
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_address[1]}/{HARNESS}"
        try:
            for scheme, number in SCHEMES.items():
                found += [f"{line} ({scheme})" for line in _look(browser, address, number)]
        finally:
            server.shutdown()
            (site / HARNESS).unlink()
    return sorted(set(found))


def _look(browser: str, address: str, scheme: int) -> list[str]:
    with tempfile.TemporaryDirectory() as profile:
        done = subprocess.run(
            [
                browser,
                "--headless",
                "--no-sandbox",  # which a container does not allow; the pages are our own
                "--disable-gpu",
                "--disable-dev-shm-usage",
                f"--user-data-dir={profile}",
                f"--blink-settings=preferredColorScheme={scheme}",
                f"--window-size={max(WIDTHS)},1000",
                "--enable-logging=stderr",
                "--timeout=600000",
                "--virtual-time-budget=600000",
                "--dump-dom",
                address,
            ],
            capture_output=True,
            text=True,
            check=False,
            timeout=SECONDS_MAX,
        )
    result = re.search(r'<pre id="found">(.*?)</pre>', done.stdout, re.DOTALL)
    if result is None:
        return [f"Chromium did not come to an end: {done.stderr[-500:]}"]
    console = re.findall(r'CONSOLE[:\d() ]*\] "(.*?)", source: (\S+)', done.stderr)
    errors = [f"the console says {text!r} at {source}" for text, source in console]
    return json.loads(html.unescape(result[1])) + errors


def main() -> int:
    browser = chromium()
    if browser is None:
        print("The pages were not looked at: there is no Chromium here.")
        return 0
    found = problems(Path(sys.argv[1]), browser)
    print("\n".join(found) or "The pages are in order, wide and narrow, light and dark.")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
