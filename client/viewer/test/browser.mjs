// Chromium as Debian has it, and a real server.

import { spawn } from "node:child_process";
import { existsSync, mkdtempSync, rmSync, writeFileSync } from "node:fs";
import { createServer } from "node:net";
import { tmpdir } from "node:os";
import { join } from "node:path";
import puppeteer from "puppeteer-core";

/** Where Chromium is; none if it is not on this machine. */
export function chromium() {
  const places = [process.env.CHROMIUM, "/usr/bin/chromium", "/usr/bin/chromium-browser", "/usr/bin/google-chrome"];
  return places.find((path) => path && existsSync(path));
}

/** A browser with WebGL in software. */
export function launch() {
  const args = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync", "--hide-scrollbars", "--disable-accelerated-2d-canvas"];
  return puppeteer.launch({ executablePath: chromium(), headless: true, args, protocolTimeout: 120_000 });
}

/** A port that nobody uses. */
function freePort() {
  return new Promise((resolve, reject) => {
    const server = createServer();
    server.on("error", reject);
    server.listen(0, "127.0.0.1", () => {
      const { port } = server.address();
      server.close(() => resolve(port));
    });
  });
}

/** A server of a binary, which can be stopped and started anew on the same port. */
export class Server {
  /** `configuration` is text of its configuration file. */
  static async start(binary, configuration = "") {
    const server = new Server();
    server.binary = binary;
    server.folder = mkdtempSync(join(tmpdir(), "plantd-viewer-"));
    writeFileSync(join(server.folder, "plantd.toml"), configuration);
    server.port = await freePort();
    server.url = `http://127.0.0.1:${server.port}`;
    await server.again();
    return server;
  }

  async again() {
    const args = ["serve", "--config", join(this.folder, "plantd.toml"), "--grpc", `127.0.0.1:${this.port}`, "--metrics", "off", "--link", "off", "--recordings", join(this.folder, "recordings")];
    this.process = spawn(this.binary, args, { stdio: ["ignore", "ignore", "inherit"] });
    for (let attempt = 0; attempt < 600; attempt++) {
      if (this.process.exitCode !== null) throw new Error(`the server ended with ${this.process.exitCode}`);
      const answer = await fetch(`${this.url}/`).catch(() => undefined);
      if (answer) {
        await answer.arrayBuffer();
        return;
      }
      await new Promise((resolve) => setTimeout(resolve, 50));
    }
    throw new Error("the server does not answer");
  }

  async stop() {
    const ended = new Promise((resolve) => this.process.once("exit", resolve));
    this.process.kill("SIGTERM");
    await ended;
  }

  async end() {
    if (this.process.exitCode === null) await this.stop();
    rmSync(this.folder, { recursive: true, force: true });
  }
}
