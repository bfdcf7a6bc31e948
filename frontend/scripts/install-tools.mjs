// Runs before `npm run check` and `npm run generate`. Installs the development dependencies when they are missing (the
// build runs `npm ci --omit=dev`) or older than the lock file.
import { execSync } from "node:child_process";
import { existsSync, statSync } from "node:fs";
import { join } from "node:path";
import { fileURLToPath } from "node:url";

const page = fileURLToPath(new URL("..", import.meta.url));
const installed = join(page, "node_modules", ".package-lock.json");
const fresh =
  existsSync(join(page, "node_modules", "@biomejs", "biome")) &&
  existsSync(installed) &&
  statSync(installed).mtimeMs >= statSync(join(page, "package-lock.json")).mtimeMs;

if (!fresh) execSync("npm ci --no-audit --no-fund", { cwd: page, stdio: "inherit" });
