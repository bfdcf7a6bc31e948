import type { UserAccount } from "@/shared/api/types";

type Role = UserAccount["role"];

/** What each role may do, for the person who chooses it. */
export const ROLES: readonly (readonly [Role, string])[] = [
  ["labeller", "Labeller: compares clips"],
  ["researcher", "Researcher: also runs experiments"],
  ["admin", "Admin: also manages people"],
  ["teacher", "Teacher: a program that labels"],
];

/** Whether access to single experiments applies to a role. The others see every experiment. */
export function canBeLimited(role: Role): boolean {
  return role === "labeller" || role === "teacher";
}
