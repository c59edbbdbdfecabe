// The scripts of a page stand in one scope, in the order of nerfbake/formats/page/view.py: what one of them does not
// find may be another's, which tsc knows.
const recommended = {
  "array-callback-return": "error", "constructor-super": "error", "curly": ["error", "multi-line"], "default-case-last": "error",
  "eqeqeq": "error", "for-direction": "error", "getter-return": "error", "no-async-promise-executor": "error",
  "no-case-declarations": "error", "no-class-assign": "error", "no-compare-neg-zero": "error", "no-cond-assign": "error",
  "no-const-assign": "error", "no-constant-condition": ["error", { checkLoops: false }], "no-control-regex": "error",
  "no-debugger": "error", "no-dupe-args": "error", "no-dupe-class-members": "error", "no-dupe-else-if": "error",
  "no-dupe-keys": "error", "no-duplicate-case": "error", "no-empty": "error", "no-eval": "error",
  "no-fallthrough": "error", "no-func-assign": "error", "no-global-assign": "error", "no-implied-eval": "error",
  "no-inner-declarations": "error", "no-invalid-regexp": "error", "no-irregular-whitespace": "error",
  "no-loss-of-precision": "error", "no-new-func": "error", "no-obj-calls": "error", "no-prototype-builtins": "error",
  "no-redeclare": "error", "no-self-assign": "error", "no-self-compare": "error", "no-setter-return": "error",
  "no-shadow-restricted-names": "error", "no-sparse-arrays": "error", "no-this-before-super": "error",
  "no-throw-literal": "error", "no-unexpected-multiline": "error", "no-unreachable": "error",
  "no-unsafe-finally": "error", "no-unsafe-negation": "error", "no-unused-expressions": ["error", { allowShortCircuit: true }],
  "no-unused-labels": "error", "no-useless-catch": "error", "no-useless-escape": "error", "no-var": "error",
  "no-with": "error", "prefer-const": "error", "require-yield": "error", "use-isnan": "error", "valid-typeof": "error",
};

export default [
  {
    files: ["**/*.js"],
    languageOptions: { ecmaVersion: 2022, sourceType: "script" },
    linterOptions: { reportUnusedDisableDirectives: "error" },
    rules: { ...recommended, "max-len": ["error", { code: 180 }], "max-lines": ["error", 300] },
  },
];
