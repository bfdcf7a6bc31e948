import { fileURLToPath } from "node:url";
import react from "@vitejs/plugin-react";
import { defineConfig } from "vite";

const server = process.env.ACCORD_SERVER ?? "http://127.0.0.1:8000";

export default defineConfig({
  plugins: [react()],
  resolve: { alias: { "@": fileURLToPath(new URL("./src", import.meta.url)) } },
  build: {
    outDir: "../backend/accord/static",
    emptyOutDir: true,
    license: { fileName: "licenses.md" },
    target: "es2022",
  },
  // `npm run dev` serves the page with hot reloading and forwards API requests to a running `accord up`.
  server: { proxy: { "/api": server, "/sign-in": server } },
});
