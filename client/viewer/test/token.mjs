// The page of a server that asks who one is.

import assert from "node:assert/strict";
import { execFile } from "node:child_process";
import { mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { dirname, join } from "node:path";
import { promisify } from "node:util";
import { Server } from "./browser.mjs";

const execute = promisify(execFile);

export const tokenTests = ({ binary, browser, until }) => ({
  async "a server that knows nobody asks for a token, and a tab keeps it"() {
    const plantctl = join(dirname(binary), "plantctl");
    const folder = mkdtempSync(join(tmpdir(), "plantd-tokens-"));
    const file = join(folder, "tokens.toml");
    const token = async (name, role) => {
      const { stdout } = await execute(plantctl, ["--json", "token", "new", name, "--role", role, "--tenant", "lab", "--file", file]);
      return JSON.parse(stdout).token;
    };
    const [driver, viewer] = [await token("dora", "driver"), await token("vera", "viewer")];
    const server = await Server.start(binary, `[auth]\ntokens = ${JSON.stringify(file)}\n`);
    try {
      await execute(plantctl, ["create", "pendulum", "--id", "p1"], { env: { ...process.env, PLANTD_ADDRESS: server.url, PLANTD_TOKEN: driver } });

      const page = await browser.newPage();
      const seen = []; // Addresses and headers that leave the page.
      page.on("request", (request) => seen.push([request.url(), request.headers().authorization ?? ""]));
      const asks = (what) => until(page, what, () => document.getElementById("token").open);
      const answer = async (text) => {
        await page.focus("#token input");
        await page.keyboard.type(text);
        await page.keyboard.press("Enter");
      };
      const shows = () => until(page, "the plant", () => window.plantdView?.shown().step !== undefined);
      await page.goto(`${server.url}/?plant=p1`);
      await asks("the question");
      assert.ok(seen.every(([, header]) => header === ""), "a header before there is a token");
      await answer("nobody's");
      await until(page, "the refusal", () => document.getElementById("token").open && document.querySelector("#token input").value === "");
      await answer(viewer);
      await shows();
      // It is kept for this tab, and in no address.
      await page.reload();
      await shows();
      const other = await (await browser.createBrowserContext()).newPage();
      await other.goto(`${server.url}/?plant=p1`);
      await until(other, "the question in another browser", () => document.getElementById("token").open);
      await other.browserContext().close();

      // Whoever may look may not drive, and is told.
      await page.click("#step");
      await until(page, "the refusal", () => /driver/.test(document.getElementById("notice").textContent));
      assert.equal(await page.evaluate(() => window.plantdView.shown().step), 0);

      // Of a link with a token nothing is left in the address.
      await page.goto("about:blank");
      await page.goto(`${server.url}/?plant=p1#token=${driver}`);
      await shows();
      assert.equal(await page.evaluate(() => location.hash), "");
      await page.click("#step");
      await until(page, "a step", () => window.plantdView.shown().step === 1);
      assert.ok(seen.every(([url]) => !url.includes(viewer) && (url.includes("#token=") || !url.includes(driver))), "a token in an address");
      assert.ok(seen.every(([url, header]) => header === "" || new URL(url).origin === server.url), "a token for somebody else");

      // One that is taken away ends what is seen, and another one is asked for.
      await execute(plantctl, ["token", "revoke", "dora", "--file", file]);
      await asks("the question after the token has gone");
      await answer(viewer);
      await until(page, "the plant again", () => !document.getElementById("token").open && document.getElementById("status").hidden);
      await page.close();
    } finally {
      await server.end();
      rmSync(folder, { recursive: true, force: true });
    }
  },
});
