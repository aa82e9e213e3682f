// Runs a policy from the folder that `gaitgauge export --layout unitree` writes, as a robot's controller does, over states that
// record.py wrote down, and compares its actions and joint targets with those of gaitgauge, step by step.
//
// What a robot measures is in the order of the maker's SDK; what the network sees and gives is in the policy's.

#include <onnxruntime_cxx_api.h>
#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <cmath>
#include <deque>
#include <fstream>
#include <iostream>
#include <map>
#include <memory>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

using Values = std::vector<float>;
using Measured = std::vector<double>;

// What a robot tells its controller in one step, motors in the SDK's order, and what gaitgauge did with it.
struct Recorded {
  Measured angular_velocity, gravity, command, position, velocity, action, target;
};

// One term of the observation: its scale, its limits before scaling, and its past values.
struct Term {
  std::string name;
  Values scale, low, high;
  std::size_t length;
  std::deque<Values> history;

  // Adds a value and returns the whole history, oldest first. The first value fills it.
  Values remember(const Measured& measured) {
    Values value(measured.size());
    for (std::size_t i = 0; i < value.size(); ++i)
      value[i] = std::clamp(static_cast<float>(measured[i]), low[i], high[i]) * scale[i];
    do history.push_back(value);
    while (history.size() < length);
    if (history.size() > length) history.pop_front();
    Values all;
    for (const Values& each : history) all.insert(all.end(), each.begin(), each.end());
    return all;
  }
};

class Controller {
 public:
  explicit Controller(const std::string& folder)
      : environment_(ORT_LOGGING_LEVEL_WARNING, "controller"),
        session_(environment_, (folder + "/exported/policy.onnx").c_str(), Ort::SessionOptions{}) {
    const YAML::Node settings = YAML::LoadFile(folder + "/params/deploy.yaml");
    motor_ = settings["joint_ids_map"].as<std::vector<int>>();
    pose_ = settings["default_joint_pos"].as<Values>();
    const YAML::Node action = settings["actions"]["JointPositionAction"];
    action_scale_ = action["scale"].as<Values>();
    offset_ = action["offset"].as<Values>();
    clip_ = action["clip"].as<std::vector<Values>>();
    for (const auto& entry : settings["observations"]) {  // in the file's order, which is the network's
      Term term;
      term.name = entry.first.as<std::string>();
      term.scale = entry.second["scale"].as<Values>();
      const Values clip = entry.second["clip"].as<Values>();
      term.low.assign(term.scale.size(), clip.at(0));
      term.high.assign(term.scale.size(), clip.at(1));
      term.length = entry.second["history_length"].as<std::size_t>();
      terms_.push_back(term);
    }
    action_.assign(pose_.size(), 0.0f);
    period_ = settings["step_dt"].as<double>();
  }

  // The network's output for one step, in the policy's order.
  const Values& act(const Recorded& state) {
    Values input;
    for (Term& term : terms_) {
      const Values history = term.remember(value_of(term.name, state));
      input.insert(input.end(), history.begin(), history.end());
    }
    const std::int64_t shape[] = {1, static_cast<std::int64_t>(input.size())};
    const Ort::MemoryInfo memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
    const Ort::Value tensor = Ort::Value::CreateTensor<float>(memory, input.data(), input.size(), shape, 2);
    const char* inputs[] = {"obs"};
    const char* outputs[] = {"actions"};
    const auto result = session_.Run(Ort::RunOptions{nullptr}, inputs, &tensor, 1, outputs, 1);
    const float* data = result.front().GetTensorData<float>();
    action_.assign(data, data + pose_.size());
    return action_;
  }

  // Replaces the last output, so that a step starts from the recorded one and rounding does not grow from step to step.
  void set_last_action(const Measured& action) { action_.assign(action.begin(), action.end()); }

  // Time between two steps [s].
  double period() const { return period_; }

  // Joint targets [rad] of the last output, in the SDK's order.
  Values targets() const {
    Values found(motor_.size());
    for (std::size_t i = 0; i < motor_.size(); ++i)
      found[motor_[i]] = std::clamp(offset_[i] + action_scale_[i] * action_[i], clip_[i][0], clip_[i][1]);
    return found;
  }

 private:
  Measured value_of(const std::string& name, const Recorded& state) const {
    if (name == "base_ang_vel") return state.angular_velocity;
    if (name == "projected_gravity") return state.gravity;
    if (name == "velocity_commands") return state.command;
    if (name == "last_action") return {action_.begin(), action_.end()};
    if (name != "joint_pos_rel" && name != "joint_vel_rel")
      throw std::runtime_error("the observation '" + name + "' is not known to this controller");
    Measured found(motor_.size());
    for (std::size_t i = 0; i < motor_.size(); ++i)
      found[i] = name == "joint_vel_rel" ? state.velocity[motor_[i]] : state.position[motor_[i]] - pose_[i];
    return found;
  }

  Ort::Env environment_;
  Ort::Session session_;
  std::vector<int> motor_;
  Values pose_, action_scale_, offset_, action_;
  std::vector<Values> clip_;
  std::vector<Term> terms_;
  double period_ = 0.0;
};

// Reads what record.py wrote: a line of column names, then one line for each step.
std::vector<Recorded> read(const std::string& path) {
  std::ifstream file(path);
  std::string line, cell;
  if (!std::getline(file, line)) throw std::runtime_error("'" + path + "' cannot be read; write it with record.py");
  std::vector<std::string> columns;
  for (std::istringstream cells(line); std::getline(cells, cell, ',');)
    columns.push_back(cell.substr(0, cell.find('.')));  // action.3 is an entry of action
  std::vector<Recorded> steps;
  while (std::getline(file, line)) {
    std::map<std::string, Measured> row;
    std::istringstream cells(line);
    for (const std::string& name : columns) {
      std::getline(cells, cell, ',');
      row[name].push_back(std::stod(cell));
    }
    steps.push_back({row["angular_velocity"], row["gravity"], row["command"], row["position"], row["velocity"],
                     row["action"], row["target"]});
  }
  return steps;
}

// Writes a line for each step, motors in the SDK's order: a log for 'gaitgauge preflight' and 'gaitgauge replay'.
class Log {
 public:
  explicit Log(const std::string& path) : file_(path) {
    if (!file_) throw std::runtime_error("'" + path + "' cannot be written");
  }

  void add(double time, const Values& target, const Recorded& state) {
    if (file_.tellp() == std::streampos(0)) {
      file_ << "time";
      for (const char* name : {"q_des_", "q_", "dq_"})
        for (std::size_t i = 0; i < target.size(); ++i) file_ << "," << name << i;
      file_ << ",ang_vel_0,ang_vel_1,ang_vel_2\n";
    }
    file_ << time;
    write(target);
    write(state.position);
    write(state.velocity);
    write(state.angular_velocity);
    file_ << "\n";
  }

 private:
  template <typename Numbers>
  void write(const Numbers& numbers) {
    for (const auto number : numbers) file_ << "," << number;
  }

  std::ofstream file_;
};

double difference(const Values& a, const Measured& b) {
  if (a.size() != b.size()) throw std::runtime_error("the recording is of another robot");
  double most = 0.0;
  for (std::size_t i = 0; i < a.size(); ++i) {
    const double apart = std::abs(a[i] - b[i]);
    most = apart <= most ? most : apart;  // what is not a number stays
  }
  return most;
}

int main(int count, char** words) {
  if (count != 3 && count != 4) {
    std::cerr << "usage: controller FOLDER STATES.csv [LOG.csv], with the folder of 'gaitgauge export --layout unitree'\n";
    return 2;
  }
  try {
    Controller controller(words[1]);
    double actions = 0.0, targets = 0.0;
    const std::vector<Recorded> steps = read(words[2]);
    std::unique_ptr<Log> log;
    if (count == 4) log = std::make_unique<Log>(words[3]);
    double time = 0.0;
    for (const Recorded& step : steps) {
      actions = std::max(difference(controller.act(step), step.action), actions);
      if (log) log->add(time, controller.targets(), step);
      time += controller.period();
      targets = std::max(difference(controller.targets(), step.target), targets);
      controller.set_last_action(step.action);
    }
    const bool same = !steps.empty() && actions <= 1e-5 && targets <= 1e-5;
    std::cout << steps.size() << " steps, onnxruntime " << Ort::GetVersionString() << ": actions differ by at most " << actions
              << ", joint targets by " << targets << " rad: " << (same ? "the same" : "NOT the same") << "\n";
    return same ? 0 : 1;
  } catch (const std::exception& error) {
    std::cerr << "controller: " << error.what() << "\n";
    return 2;
  }
}
