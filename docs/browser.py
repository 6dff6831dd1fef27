"""Looks at the built site in a headless Chromium, on a wide and on a narrow screen, light and dark.

    python docs/browser.py site

Says which pages overflow the screen, cut off a line of code, lack a picture, load something from
another host or write errors to the console, and exits with status 1 if any does. Without Chromium
it says so, and looks at nothing.
"""

import shutil
import sys
from pathlib import Path
from urllib.parse import urlsplit

from playwright.sync_api import sync_playwright

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
HOST = "http://site"
WIDTHS = (1920, 1280, 390)
# From here on a line of code must not be cut off; on a telephone it scrolls.
WHOLE = 1280

# Only what scrolls by itself, as code, formulas and tables do, may be wider than the screen.
SCRIPT = """
async whole => {
  const root = document.documentElement, found = [], images = [...document.images];
  for (const image of images) image.loading = "eager";
  await Promise.all(images.map(image => image.decode().catch(() => {})));
  for (const code of document.querySelectorAll("pre > code"))
    if (whole && code.scrollWidth > code.clientWidth)
      found.push(`cuts off: ${code.innerText.trim().split("\\n")[0]}`);
  if (root.scrollWidth > root.clientWidth) found.push(`is ${root.scrollWidth} pixels wide`);
  for (const image of images)
    if (image.naturalWidth === 0) found.push(`has no picture ${image.getAttribute("src")}`);
  return found;
}
"""

# The theme's script lays out a page after it has loaded, at a moment that nothing announces: what
# it mends within these looks, a tenth of a second apart, is no problem.
LOOKS = 300
# In milliseconds, on a machine that does other work beside it.
TIMEOUT = 120_000


def problems(site: Path, chromium: str) -> list[str]:
    """What is wrong with the site in this folder, one line each."""
    found = []

    def serve(route):
        file = site / urlsplit(route.request.url).path.lstrip("/")
        if not route.request.url.startswith(f"{HOST}/"):
            found.append(f"{page.url} loads {route.request.url}")
            route.abort()
        elif file.is_file():
            route.fulfill(path=file)
        else:
            route.fulfill(status=404)

    with sync_playwright() as playwright:
        # Without a sandbox, which a container does not allow; the pages are our own.
        browser = playwright.chromium.launch(executable_path=chromium, chromium_sandbox=False)
        page = browser.new_page()
        page.set_default_timeout(TIMEOUT)
        page.route("**/*", serve)
        page.on("console", lambda message: found.append(f"{page.url} says {message.text}"))
        page.on("pageerror", lambda error: found.append(f"{page.url} says {error}"))
        for file in sorted(site.rglob("*.html")):
            page.goto(f"{HOST}/{file.relative_to(site).as_posix()}")
            for scheme in ("light", "dark"):
                page.emulate_media(color_scheme=scheme)
                for width in WIDTHS:
                    page.set_viewport_size({"width": width, "height": 900})
                    for _ in range(LOOKS):
                        if not (seen := page.evaluate(SCRIPT, width >= WHOLE)):
                            break
                        page.wait_for_timeout(100)
                    found += [f"{page.url} {text} ({width} pixels, {scheme})" for text in seen]
        browser.close()
    return sorted(set(found))


def main() -> int:
    chromium = next(filter(None, map(shutil.which, BROWSERS)), None)
    if chromium is None:
        print("The pages were not looked at: there is no Chromium here.")
        return 0
    found = problems(Path(sys.argv[1]), chromium)
    print("\n".join(found) or "The pages are in order, wide and narrow, light and dark.")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
