// Fails when src/shared/api/schema.d.ts differs from what openapi.json generates.
import { execFileSync } from "node:child_process";
import { mkdtempSync, readFileSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { fileURLToPath } from "node:url";

const page = fileURLToPath(new URL("..", import.meta.url));
const folder = mkdtempSync(join(tmpdir(), "accord-client-"));
const fresh = join(folder, "schema.d.ts");

try {
  const cli = join(page, "node_modules", "openapi-typescript", "bin", "cli.js");
  execFileSync(process.execPath, [cli, "openapi.json", "--output", fresh], { cwd: page, stdio: "pipe" });
  if (readFileSync(fresh, "utf8") !== readFileSync(join(page, "src/shared/api/schema.d.ts"), "utf8")) {
    console.error("src/shared/api/schema.d.ts is out of date: run `npm run generate` and commit the result.");
    process.exitCode = 1;
  }
} finally {
  rmSync(folder, { recursive: true, force: true });
}
