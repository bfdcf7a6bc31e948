import { createRoot } from "react-dom/client";
import { App } from "@/app/App";
import "@/shared/ui/theme.css";
import "@/shared/ui/layout.css";
import "@/shared/ui/components.css";

const root = document.getElementById("root");
if (!root) throw new Error("index.html has no #root");
createRoot(root).render(<App />);
