// Publishes a greeting twice a second on `chatter` and says one at once when the service `say` asks for it.
#include <string>

#include <ros/ros.h>
#include <std_msgs/String.h>
#include <std_srvs/Trigger.h>

class Talker {
 public:
  Talker()
      : greeting_(ros::NodeHandle("~").param<std::string>("greeting", "hello")),
        publisher_(node_.advertise<std_msgs::String>("chatter", 10)),
        service_(node_.advertiseService("say", &Talker::onSay, this)),
        timer_(node_.createWallTimer(ros::WallDuration(0.5), [this](const ros::WallTimerEvent&) { say(); })) {}

 private:
  std::string say() {
    std_msgs::String message;
    message.data = greeting_ + " " + std::to_string(++said_);
    publisher_.publish(message);
    return message.data;
  }

  bool onSay(std_srvs::Trigger::Request&, std_srvs::Trigger::Response& response) {
    response.success = true;
    response.message = say();
    return true;
  }

  ros::NodeHandle node_;
  const std::string greeting_;
  int said_ = 0;
  ros::Publisher publisher_;
  ros::ServiceServer service_;
  ros::WallTimer timer_;
};

int main(int argc, char** argv) {
  ros::init(argc, argv, "talker");
  const Talker talker;
  // Until SIGINT, which roslaunch sends when it ends.
  ros::spin();
}
