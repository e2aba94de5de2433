# SPDX-License-Identifier: MIT
"""Base for all commands: options built from settings, one-line errors, exit codes."""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING
from enum import IntEnum
from typing import Annotated, Any, ClassVar, Generic, TypeVar, get_args, get_origin

import typer
from typer.core import TyperCommand, TyperGroup
from typer.models import OptionInfo

from rfm_client.contract import errors
from rfm_client.contract.settings import ConfigError, Setting, Settings, Texts, placeholder_of
from rfm_client.contract.triton import FEWER_FRAMES

STANDARD_OUTPUT = "-"
MOST_COLUMNS = 110  # widest help text, if the terminal is that wide

_FIRST, _LAST = ("Arguments", "Options"), ("Server", "Credentials")  # sections in a help text
UsageError: type[Exception] = typer.BadParameter.__mro__[1]  # from click, or from typer's own copy of click
_EXPECTED = {"int_parsing": "a whole number", "int_from_float": "a whole number", "float_parsing": "a number"}

S = TypeVar("S", bound=Settings)


class OptionValues(dict[str, Any], Generic[S]):
    """Option values from the command line, by setting name in S."""


class ExitCode(IntEnum):
    """Exit codes of commands, for scripts."""

    OK = 0
    FAILED = 1
    USAGE = 2
    UNAVAILABLE = 3
    DEADLINE = 4
    NO_MODEL = 5
    INTERRUPTED = 130


EXIT_CODES = (
    "Exit codes: 0 done; 1 a sample (or anything not named here) failed; 2 wrong usage; 3 server unavailable; "
    "4 out of time; 5 model not served; 130 interrupted. Errors are written to standard error, one a line."
)

_ERROR_CODES: dict[type[BaseException], ExitCode] = {
    errors.ServerUnavailableError: ExitCode.UNAVAILABLE,
    errors.DeadlineExceededError: ExitCode.DEADLINE,
    errors.ModelNotFoundError: ExitCode.NO_MODEL,
}


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Return the command with one option per setting in its ``Settings`` and ``OptionValues`` parameters."""
    # not typing.get_type_hints, which in Python 3.10 hides a parameter's annotation if the default is None
    own = inspect.signature(command, eval_str=True).parameters.values()
    chosen = {each.name: kind for each in own if (kind := _settings_class(each.annotation)) is not None}
    options = {name: [each for each in kind.settings().values() if each.has_option] for name, kind in chosen.items()}
    parameters: list[inspect.Parameter] = []
    for each in own:
        if each.name in options:
            parameters += map(_parameter, options[each.name])
        else:
            _set_placeholder(each.annotation)
            parameters.append(each.replace(kind=inspect.Parameter.KEYWORD_ONLY))
    are_given = {each.name for each in own if get_origin(each.annotation) is OptionValues}

    @functools.wraps(command)
    def run(**values: Any) -> None:
        typed = {
            each.name: each.option for some in options.values() for each in some if values[_key(each)] not in (None, [])
        }
        try:
            for name, kind in chosen.items():
                given = _given(options[name], values)
                values[name] = given if name in are_given else kind(**given)
            command(**values)
        except ConfigError as error:
            raise _named(error, {each.name: each.option for some in options.values() for each in some}) from None
        except errors.LocatedError as error:  # about what an option names: a server, a dataset
            typed |= {option.strip("-").replace("-", "_"): option for option in typed.values()}
            if error.where not in typed or error.where == "frames":  # about a sample
                raise
            raise error.like(error, where=typed[error.where]) from None

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # typer reads it
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


class Command(TyperCommand):
    """A command with a help section for each option group, and one-line errors without traceback."""

    program = "rfm-client"
    has_codes = True  # False: every error exits with 1
    unknown_option = ""  # added to the error about an unknown {option}

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words. Raises typer.BadParameter in the command line's words."""
        try:
            return super().parse_args(ctx, args)
        except typer.BadParameter as error:
            error.message = in_plain_words(error)
            raise
        except UsageError as error:
            if self.unknown_option and (unknown := getattr(error, "option_name", "")):
                vars(error)["message"] += f": {self.unknown_option.format(option=unknown)}"
            raise

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the words in the usage line: argument names, in brackets if optional."""
        arguments = [each for each in self.get_params(ctx) if each.param_type_name == "argument"]
        names = [argument_name(each) if each.required else f"[{argument_name(each)}]" for each in arguments]
        return [*([self.options_metavar] if self.options_metavar else []), *names]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write sections for the arguments, the command's own options, and each settings group."""
        write_options(self, ctx, formatter)

    def invoke(self, ctx: Any) -> Any:
        """Run the command, and report errors with the program's name on every line."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            code, lines = ExitCode.INTERRUPTED, ["interrupted"]
        except BrokenPipeError:  # whoever reads the output has closed the pipe
            raise
        except ImportError as error:
            code, lines = ExitCode.FAILED, [missing_package(error)]
        except (errors.LocatedError, errors.RewardError, OSError) as error:
            code = exit_code(error) if self.has_codes else ExitCode.FAILED
            lines = user_message(error).split("\n")
        for line in lines:
            report(line, self.program)
        raise typer.Exit(code)


class CommandGroup(TyperGroup):
    """Lists the commands before the options in the help."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the commands, then the options."""
        self.format_commands(ctx, formatter)
        write_options(self, ctx, formatter)


class Commands(CommandGroup):
    """The ``rfm-client`` commands.

    elsewhere: commands of the other program
    missing: by command of an application that is not installed, how to install it
    """

    program, other_program = "rfm-client", "rfm"
    elsewhere: Collection[str] = ("export", "serve", "try", "models")
    missing: ClassVar[dict[str, str]] = {
        **dict.fromkeys(("evaluate", "label"), "pip install ./client ./apps/labels"),
        "gateway": "pip install ./client ./apps/gateway",
    }

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command. Raises a usage error that names the right program, typer.Exit if a package is missing."""
        name = args[0]
        if self.get_command(ctx, name) is None and name in self.elsewhere:
            ctx.fail(f"No such command '{name}': that is `{self.other_program} {name}`")
        if self.get_command(ctx, name) is None and name in self.missing:
            report(f"{name}: expected its package, got none: {self.missing[name]}", self.program)
            raise typer.Exit(ExitCode.FAILED)
        return super().resolve_command(ctx, args)


def exit_code(error: BaseException) -> ExitCode:
    """Return the exit code of a command that fails with this error."""
    return next((code for kind, code in _ERROR_CODES.items() if isinstance(error, kind)), ExitCode.FAILED)


def exit_code_of(failures: Sequence[Exception], *, some_succeeded: bool) -> ExitCode:
    """Return the exit code after sample failures: a special code only if all samples failed for one reason."""
    codes = {exit_code(error) for error in failures}
    if not codes:
        return ExitCode.OK
    return codes.pop() if len(codes) == 1 and not some_succeeded else ExitCode.FAILED


def report(message: str, program: str = "rfm-client") -> None:
    """Write the message as one line to standard error."""
    print(f"{program}: {' '.join(message.split())}", file=sys.stderr, flush=True)


@contextmanager
def usage_errors(option: str) -> Iterator[None]:
    """Turn a ValueError into a usage error for ``option``."""
    try:
        yield
    except ValueError as error:
        raise typer.BadParameter(str(getattr(error, "problem", error)), param_hint=f"'{option}'") from error


def missing_package(error: ImportError) -> str:
    """Return the error's message with the command that installs the package."""
    if "pip install" in str(error):
        return str(error)
    return f'{error}: pip install "./client[cli]"'


def _named(error: ConfigError, options: Mapping[str, str]) -> Exception:
    """Return a usage error for the options behind the settings in the error; the error itself for other settings."""
    if not {error.where, error.other or error.where} <= options.keys():
        return error
    named = error.named(options.__getitem__)
    if error.other:
        return typer.BadParameter(str(named))
    return typer.BadParameter(named.problem, param_hint=f"'{named.where}'")


def _settings_class(hint: Any) -> type[Settings] | None:
    """Return the Settings class behind a parameter, plain or as ``OptionValues``; None for any other parameter."""
    (kind,) = get_args(hint) if get_origin(hint) is OptionValues else (hint,)
    return kind if isinstance(kind, type) and issubclass(kind, Settings) else None


def _parameter(setting: Setting) -> inspect.Parameter:
    """Return a setting's typer parameter. The default is None, so that a file or the setting's default can decide."""
    must_be_given = setting.default is MISSING
    described = typer.Option(
        f"{setting.option}/{setting.negation}" if setting.default is True else setting.option,
        help=_help(setting),
        metavar=setting.placeholder,
        envvar=setting.variable,
        show_default=False,
        show_envvar=False,  # ``help`` shows it
        rich_help_panel=setting.title,
    )
    kind = list[str] if setting.parse or setting.kind == Texts else setting.kind
    return inspect.Parameter(
        _key(setting),
        inspect.Parameter.KEYWORD_ONLY,
        default=inspect.Parameter.empty if must_be_given else None,
        annotation=Annotated[kind if must_be_given else kind | None, described],
    )


def _key(setting: Setting) -> str:
    """Return the name of the parameter from ``_parameter``, which no command's own parameter has."""
    return f"{setting.prefix}{setting.name}_option".replace("-", "_")


def _help(setting: Setting) -> str:
    """Return the help text with the option's bounds, default and variable."""
    default = setting.option if setting.default is True else _shown(setting.default)
    facts = [
        *([setting.bounds] if setting.bounds else []),
        *([f"default: {default}"] if default else []),
        *([f"variable: {setting.variable}"] if setting.variable else []),
    ]
    return f"{setting.help}  [{'; '.join(facts)}]" if facts else setting.help


def _given(options: Sequence[Setting], values: dict[str, Any]) -> OptionValues[Any]:
    """Remove the options from ``values``, and return the given settings. Raises typer.BadParameter."""
    given = OptionValues[Any]()
    for each in options:
        value = values.pop(_key(each))
        if value in (None, []):
            continue
        with usage_errors(each.option):
            value = each.parse(",".join(value)) if each.parse else value
        given[each.name] = tuple(value) if isinstance(value, list) else value
    return given


def _set_placeholder(hint: Any) -> None:
    """Give an option its placeholder, unless it has one."""
    for mark in get_args(hint)[1:]:
        if isinstance(mark, OptionInfo) and mark.metavar is None:
            mark.metavar = placeholder_of(get_args(hint)[0])


def _shown(default: Any) -> str:
    """Return a default as one would type it; empty for none."""
    if default is None or default is False or default is MISSING:
        return ""
    if isinstance(default, tuple):
        return " ".join(map(str, default))
    return f"{default:g}" if isinstance(default, float) else str(default)


def user_message(error: Exception) -> str:
    """Return the message for a command-line user, who knows options but not Python function arguments."""
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}"
    prefixes = "score prefixes of fewer frames (rfm-client score --sampling rint_pad)"
    return str(with_remedy(error, f"leave out --no-subsample, or {prefixes}"))


def with_remedy(error: Exception, remedy: str) -> Exception:
    """Return a too-many-frames error with this remedy, or none if empty; return other errors as they are."""
    if isinstance(error, errors.LocatedError) and error.remedy == FEWER_FRAMES:
        return type(error).at(error.where, error.expected, error.got, remedy)
    return error


def in_plain_words(error: typer.BadParameter) -> str:
    """Return the message for an invalid value, without the words of pydantic, which typer validates with."""
    details: list[Any] = getattr(error.__cause__, "errors", list)()
    expected = _EXPECTED.get(details[0]["type"]) if details else None
    if expected is None:
        return error.message.removeprefix("Value error, ")
    return f"expected {expected}, got {details[0]['input']!r}"


def write_options(command: Any, ctx: Any, formatter: Any) -> None:
    """Write a section for each parameter group; required parameters come first in a section."""
    sections: dict[str, list[tuple[str, str]]] = {title: [] for title in _FIRST}
    for parameter in sorted(command.get_params(ctx), key=lambda each: not each.required):
        record = parameter.get_help_record(ctx)
        if record is not None:
            is_argument = parameter.param_type_name == "argument"
            record = (argument_name(parameter), record[1]) if is_argument else record
            title = "Arguments" if is_argument else getattr(parameter, "rich_help_panel", None) or "Options"
            sections.setdefault(title, []).append(record)
    last = [title for title in _LAST if title in sections]
    for title in [*(title for title in sections if title not in last), *last]:
        if sections[title]:
            with formatter.section(title):
                formatter.write_dl(sections[title])


def argument_name(parameter: Any) -> str:
    """Return an argument's name as shown in the usage line and the help."""
    return str(parameter.metavar or parameter.name.upper())
